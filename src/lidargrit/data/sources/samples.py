"""A folder of generated scans, one a file → their range images, and what it says of their model."""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidargrit.core.arrays import HEADER_BYTES_AT_MOST, read_arrays
from lidargrit.core.determinism import evenly_spaced
from lidargrit.core.errors import CheckpointError, ConfigError, DataError, ScanError
from lidargrit.core.files import read_json, sha256_of_json
from lidargrit.data.formats import open_file
from lidargrit.data.images import Pixels, Provenance, RangeImages
from lidargrit.scans.sensors import SensorModel

MANIFEST = "samples.json"


class SampleFacts(NamedTuple):
    """What the manifest of a folder of samples says of them and of their model.

    Args:
        projection_variant: variant of the projection by which the model's training scans became images; "" if unknown.
        full_rows: rows in which every ray returns, with none in the others; None where rays may drop.
        weights_sha256: hash of the weights that generated the samples; "" if unknown.
        model_and_sampling: hash that two sets of samples share if equal seeds in them are the same scans.
    """

    sensor: SensorModel
    projection_variant: str
    full_rows: range | None
    weights_sha256: str
    model_and_sampling: str


def read_facts(folder: Path) -> SampleFacts:
    """Read the manifest of a folder that :func:`lidargrit.inference.samples.write_samples` wrote."""
    manifest, wanted = read_json(folder / MANIFEST), "what lidargrit wrote"
    try:
        sensor = SensorModel.from_json(manifest["sensor"])
    except (KeyError, TypeError, ConfigError) as error:
        reason = error.got if isinstance(error, ConfigError) else error
        raise CheckpointError(f"{folder / MANIFEST}, in which {reason}", wanted, "sample anew") from None
    rows = manifest.get("full_rows")
    if rows is not None and not (isinstance(rows, list) and [*map(type, rows)] == [int, int]):
        raise CheckpointError(f"{folder / MANIFEST}, whose full_rows are no two rows", wanted, "restore it")
    variant, weights = (manifest.get(name) for name in ("projection_variant", "weights_sha256"))
    made_by = [manifest.get(name) for name in ("weights_sha256", "config", "sampling")]
    return SampleFacts(
        sensor,
        variant if isinstance(variant, str) else "",
        None if rows is None else range(*rows),
        weights if isinstance(weights, str) else "",
        sha256_of_json(made_by)[:8],
    )


def read_samples(folder: Path, count: int | None = None) -> RangeImages:
    """Return the samples of a folder in the order of their seeds; read when asked for.

    Args:
        folder: folder that :func:`lidargrit.inference.samples.write_samples` wrote.
        count: largest number of scans, evenly spaced over the seeds; all if not given.
    """
    facts = read_facts(folder)
    files = folder.glob("[!.]*.npz")  # not what a killed process left half-written
    paths = sorted(files, key=lambda path: (len(path.stem), path.stem))  # seeds above eight digits come last
    if count:
        paths = [paths[index] for index in evenly_spaced(count, len(paths))]
    if not paths:
        raise DataError(
            f"no sample in {folder}", "at least one", "generate some with: lidargrit sample RUN " + str(folder)
        )
    return RangeImages(facts.sensor, [_Files(paths, facts.sensor, facts.model_and_sampling)])


def is_sample_folder(folder: Path) -> bool:
    """Return whether a folder holds samples that lidargrit wrote."""
    return (folder / MANIFEST).is_file()


class _Files:
    def __init__(self, paths: list[Path], sensor: SensorModel, model_and_sampling: str) -> None:
        self.files, self._shape = paths, (sensor.height, sensor.width)
        self.provenance = Provenance(tuple(f"{model_and_sampling}/sample {path.stem}" for path in paths))

    def __len__(self) -> int:
        return len(self.files)

    def read(self, index: int) -> Pixels:
        path = self.files[index]
        cure = "remove the file and sample again"
        try:
            with open_file(path, "an .npz with range_m") as file:
                arrays = read_arrays(
                    file, ("range_m", "reflectance"), 8 * math.prod(self._shape) + HEADER_BYTES_AT_MOST
                )
            range_m, reflectance = arrays["range_m"], arrays.get("reflectance")
        except ScanError:
            raise
        except (OSError, ValueError, KeyError) as error:
            raise ScanError(f"{path}, which cannot be read ({error})", "an .npz with range_m", cure) from None
        if range_m.shape != self._shape or range_m.dtype != np.float32:
            raise ScanError(
                f"{range_m.dtype} {range_m.shape} in {path}", f"float32 {self._shape}, as samples.json says", cure
            )
        if not ((range_m >= 0) & np.isfinite(range_m)).all():
            raise ScanError(f"ranges that are negative or no number in {path}", "metres, 0 for no return", cure)
        if reflectance is not None and not (
            reflectance.shape == self._shape
            and reflectance.dtype == np.float32
            and ((reflectance >= 0) & (reflectance <= 1)).all()
        ):
            raise ScanError(f"a damaged reflectance in {path}", f"float32 {self._shape} in [0, 1]", cure)
        return Pixels(range_m, {} if reflectance is None else {"reflectance": reflectance})

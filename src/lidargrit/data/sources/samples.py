"""A folder of generated scans, one a file → their range images, and what it says of their model."""

import hashlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from lidargrit.core.arrays import HEADER_BYTES_AT_MOST, read_arrays
from lidargrit.core.determinism import evenly_spaced
from lidargrit.core.errors import CheckpointError, ConfigError, DataError, ScanError
from lidargrit.core.files import read_json
from lidargrit.data.formats import open_file
from lidargrit.data.images import Pixels, Provenance, RangeImages
from lidargrit.scans.sensors import SensorModel

MANIFEST = "samples.json"


def read_samples(folder: Path, count: int | None = None) -> RangeImages:
    """Return the samples of a folder in the order of their seeds; read when asked for.

    Args:
        folder: folder that :func:`lidargrit.inference.samples.write_samples` wrote.
        count: largest number of scans, evenly spaced over the seeds; all if not given.
    """
    manifest = read_json(folder / MANIFEST)
    try:
        sensor = SensorModel.from_json(manifest["sensor"])
    except (KeyError, TypeError, ConfigError) as error:
        reason = error.got if isinstance(error, ConfigError) else error
        raise CheckpointError(
            f"{folder / MANIFEST}, in which {reason}", "what lidargrit wrote", "sample anew"
        ) from None
    files = folder.glob("[!.]*.npz")  # not what a killed process left half-written
    paths = sorted(files, key=lambda path: (len(path.stem), path.stem))  # seeds above eight digits come last
    if count:
        paths = [paths[index] for index in evenly_spaced(count, len(paths))]
    if not paths:
        raise DataError(
            f"no sample in {folder}", "at least one", "generate some with: lidargrit sample RUN " + str(folder)
        )
    return RangeImages(sensor, [_Files(paths, sensor, _model_and_sampling(manifest))])


def projection_of(folder: Path) -> str:
    """Return by which variant of the projection the training scans of the samples' model became images.

    "" where that is not known.
    """
    manifest = read_json(folder / MANIFEST)
    variant = manifest.get("projection_variant") if isinstance(manifest, dict) else None
    return variant if isinstance(variant, str) else ""


def full_rows_of(folder: Path) -> range | None:
    """Return the rows in which every ray of the samples returns, with none in the others; None where rays may drop."""
    manifest = read_json(folder / MANIFEST)
    rows = manifest.get("full_rows") if isinstance(manifest, dict) else None
    if rows is None:
        return None
    if not (isinstance(rows, list) and len(rows) == 2 and all(type(row) is int for row in rows)):
        raise CheckpointError(
            f"{folder / MANIFEST}, whose full_rows are no two rows", "what lidargrit wrote", "restore it"
        )
    return range(*rows)


def weights_of(folder: Path) -> str:
    """Return the hash of the weights that generated the samples of a folder; "" where the folder does not tell."""
    manifest = read_json(folder / MANIFEST)
    found = manifest.get("weights_sha256") if isinstance(manifest, dict) else None
    return found if isinstance(found, str) else ""


def is_sample_folder(folder: Path) -> bool:
    """Return whether a folder holds samples that lidargrit wrote."""
    return (folder / MANIFEST).is_file()


class _Files:
    def __init__(self, paths: list[Path], sensor: SensorModel, model_and_sampling: str) -> None:
        self._paths, self._shape = paths, (sensor.height, sensor.width)
        self.provenance = Provenance(tuple(f"{model_and_sampling}/sample {path.stem}" for path in paths))

    def __len__(self) -> int:
        return len(self._paths)

    def read(self, index: int) -> Pixels:
        path = self._paths[index]
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


def _model_and_sampling(manifest: dict[str, Any]) -> str:
    """Return what two sets of samples share if equal seeds in them are the same scans: model and settings."""
    facts = [manifest.get(name) for name in ("weights_sha256", "config", "sampling")]
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()[:8]

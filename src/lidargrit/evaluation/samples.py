"""Generated scans on disk: (generator, seeds) → a folder of one file a scan, and back."""

from __future__ import annotations

import hashlib
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lidargrit import configuration
from lidargrit.errors import CheckpointError, DataError, OutputError, ScanError
from lidargrit.files import atomic_path, is_taken, read_json, write_json
from lidargrit.generators import WEIGHTS_FILE, Generator, SamplingConfig
from lidargrit.loading import RangeImages
from lidargrit.reporting import Reporter
from lidargrit.sensors import SensorModel

MANIFEST = "samples.json"

_UNREADABLE = (  # what numpy and zipfile raise on damaged bytes, RuntimeError also where a bit says "encrypted"
    *(OSError, ValueError, KeyError, TypeError, AttributeError, EOFError, RuntimeError),
    *(zipfile.BadZipFile, zlib.error),
)


def write_samples(
    generator: Generator,
    run_folder: Path,
    folder: Path,
    seeds: Sequence[int],
    sampling: SamplingConfig,
    batch_size: int = 8,
    reporter: Reporter | None = None,
) -> None:
    """Write one file for each seed; seeds that are there already are not drawn again.

    Args:
        generator: what to sample from, as loaded from
        run_folder: whose weights identify it.
        folder: gets ``samples.json`` and ``SEED.npz`` with ``range_m`` (H, W) in metres, 0 where nothing returned.
        seeds: one a scan.
        sampling: temperature and the like.
        batch_size: scans drawn at once; the scans do not depend on it.
        reporter: hears of the progress.

    Raises:
        OutputError: the folder holds samples of another model or setting, something else, or cannot be written.
    """
    manifest: dict[str, Any] = {
        "weights_sha256": hashlib.sha256((run_folder / WEIGHTS_FILE).read_bytes()).hexdigest(),
        "sampling": configuration.to_json(sampling),
        "sensor": generator.sensor.to_json(),
    }
    if (folder / MANIFEST).exists():
        if read_json(folder / MANIFEST) != manifest:
            raise OutputError(
                f"{folder}, which holds samples of another model or drawn in another way",
                "an empty folder, or one that this very command began",
                "choose another folder",
            )
    elif is_taken(folder, MANIFEST):
        raise OutputError(f"{folder}, which is not empty and holds no samples", "an empty folder", "choose another one")
    else:
        write_json(folder / MANIFEST, manifest)
    missing = [seed for seed in seeds if not _file(folder, seed).exists()]
    with (reporter or Reporter()).progress("sampling", len(seeds), len(seeds) - len(missing)) as progress:
        for first in range(0, len(missing), batch_size):
            some = missing[first : first + batch_size]
            images = generator.sample(some, sampling)
            for seed, range_m in zip(some, images.range_m.cpu().numpy(), strict=True):
                with atomic_path(_file(folder, seed)) as temporary:
                    np.savez_compressed(temporary, range_m=range_m)
            progress.advance(len(some))


def read_samples(folder: Path, count: int | None = None) -> RangeImages:
    """Return the samples of a folder in the order of their seeds; read when asked for.

    Args:
        folder: that :func:`write_samples` wrote.
        count: at most so many, those of the first seeds: seeds have no order that would favour any.

    Raises:
        DataError: no samples in the folder.
    """
    try:
        sensor = SensorModel.from_json(read_json(folder / MANIFEST)["sensor"])
    except (KeyError, TypeError) as error:
        raise CheckpointError(f"{folder / MANIFEST}, in which {error}", "what lidargrit wrote", "sample anew") from None
    paths = sorted(folder.glob("[!.]*.npz"))[:count]  # not what a killed process left half-written
    if not paths:
        raise DataError(f"no sample in {folder}", "at least one", "draw some with: lidargrit sample RUN " + str(folder))
    return RangeImages(sensor, [_Files(paths, sensor)], [path.stem for path in paths])


def is_sample_folder(folder: Path) -> bool:
    """Tell whether a folder holds samples that lidargrit wrote."""
    return (folder / MANIFEST).is_file()


class _Files:
    """Sample files that read like an array."""

    def __init__(self, paths: list[Path], sensor: SensorModel) -> None:
        self._paths, self._shape = paths, (sensor.height, sensor.width)

    def __len__(self) -> int:
        return len(self._paths)

    def __getitem__(self, index: int) -> np.ndarray:
        path = self._paths[index]
        cure = "remove the file and sample again"
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as opened:
                range_m = opened["range_m"]
        except _UNREADABLE as error:
            raise ScanError(f"{path}, which cannot be read ({error})", "an .npz with range_m", cure) from None
        if range_m.shape != self._shape or range_m.dtype != np.float32:
            raise ScanError(
                f"{range_m.dtype} {range_m.shape} in {path}", f"float32 {self._shape}, as samples.json says", cure
            )
        if not ((range_m >= 0) & np.isfinite(range_m)).all():
            raise ScanError(f"ranges that are negative or no number in {path}", "metres, 0 for no return", cure)
        return range_m


def _file(folder: Path, seed: int) -> Path:
    return folder / f"{seed:08d}.npz"

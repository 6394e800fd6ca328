"""Processes that simulate streets without end into a folder → range images that training reads while more come.

Neither waits for the other: training samples from the streets that are there, the processes add to them.
"""

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from lidargrit.core.files import atomic_path
from lidargrit.data.images import Pixels, Provenance, RangeImages
from lidargrit.scans.projection import project
from lidargrit.scans.sensors import SensorModel, load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.simulator import simulate

STEP_M = 0.002  # of a stored range: 16 bits reach 131 m
_NOMINAL = 1_000_000  # length of a set that has no end; index i is street i modulo those that are there
_LOOK_EVERY_S = 2.0
_FIRST_WITHIN_S = 120.0
_STREETS_PER_FILE = 8


def write_streets(folder: Path, sensor: SensorModel, first_seed: int, every: int, until_seed: int) -> None:
    """Simulate streets of the seeds ``first_seed``, ``first_seed + every``, ... into files of eight range images.

    Each file holds uint16 (n, H, fine columns), ranges in steps of 2 mm, and is named by its first and last seed.
    """
    fine = sensor.with_columns(sensor.width * sensor.column_stride, 1)
    seeds, parent = range(first_seed, until_seed, every), os.getppid()
    for begin in range(0, len(seeds), _STREETS_PER_FILE):
        if os.getppid() != parent:  # the training was killed
            return
        some = seeds[begin : begin + _STREETS_PER_FILE]
        images = [project(simulate(seed, fine), fine).range_m.numpy() for seed in some]
        with atomic_path(folder / f"{some[0]:07d}_{some[-1]:07d}.npy") as partial, partial.open("wb") as file:
            np.save(file, np.stack([np.rint(image / STEP_M).astype(np.uint16) for image in images]))


@contextmanager
def simulating(
    folder: Path, sensor_name: str, columns: tuple[int, int], first_seed: int, processes: int
) -> Iterator[None]:
    """Run processes that simulate streets within the ``with`` block, each with its own seeds."""
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, __file__, str(folder), sensor_name, *map(str, columns)]
    one_thread = {**os.environ, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    running = [
        subprocess.Popen([*command, str(first_seed + number), str(processes)], env=one_thread)
        for number in range(processes)
    ]
    try:
        yield
    finally:
        for process in running:
            process.terminate()
        for process in running:
            process.wait()


class Streets:
    """The streets in a folder as a store of images, which grows while it is read.

    Args:
        folder: folder of :func:`write_streets`.
    """

    provenance = Provenance()

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._files: set[str] = set()
        self._images: list[np.ndarray] = []
        self._looked = -_LOOK_EVERY_S

    def __len__(self) -> int:
        return _NOMINAL

    @property
    def count(self) -> int:
        """Number of streets that are there."""
        self._look()
        return len(self._images)

    def next_seed(self, first_seed: int) -> int:
        """Return the seed after the last of the streets in the folder, read or not; ``first_seed`` if there is none."""
        return max((int(path.name[8:15]) + 1 for path in self._folder.glob("*.npy")), default=first_seed)

    def read(self, index: int) -> Pixels:
        """Return the street of an index, modulo those that are there; wait for the first one."""
        self._look()
        begun = time.monotonic()
        while not self._images:
            if time.monotonic() - begun > _FIRST_WITHIN_S:
                raise TimeoutError(f"no street in {self._folder} after {_FIRST_WITHIN_S:g} s: is a process simulating?")
            time.sleep(0.2)
            self._look()
        return Pixels(self._images[index % len(self._images)].astype(np.float32) * np.float32(STEP_M))

    def _look(self) -> None:
        if time.monotonic() - self._looked < _LOOK_EVERY_S:
            return
        self._looked = time.monotonic()
        for path in sorted(self._folder.glob("*.npy")):
            if path.name not in self._files:
                self._images.extend(np.load(path))
                self._files.add(path.name)

    def images(self, sensor: SensorModel) -> RangeImages:
        """Return the streets as range images of a sensor."""
        return RangeImages(sensor, [self])


class ValidationStreets:
    """Labelled streets on which a leg is judged, as a store of images; they are simulated beside the training.

    Args:
        sensor: sensor of the images.
        seeds: seeds of the streets.
        pool: processes that simulate them.
    """

    provenance = Provenance()

    def __init__(self, sensor: SensorModel, seeds: range, pool: ProcessPoolExecutor) -> None:
        self.sensor, self._made = sensor, [pool.submit(_labelled, seed, sensor) for seed in seeds]

    def __len__(self) -> int:
        return len(self._made)

    def read(self, index: int) -> Pixels:
        """Return the ranges of one street."""
        return Pixels(self._made[index].result().range_m.numpy())

    @property
    def labelled(self) -> RangeImage:
        """All streets with their labels, as a batch."""
        return RangeImage.stack([one.result() for one in self._made])

    def images(self) -> RangeImages:
        """Return the streets as range images without labels."""
        return RangeImages(self.sensor, [self])


def _labelled(seed: int, sensor: SensorModel) -> RangeImage:
    return project(simulate(seed, sensor, kept_columns_only=True), sensor)


def _main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("sensor")
    for name in ("columns", "stride", "first_seed", "every"):
        parser.add_argument(name, type=int)
    given = parser.parse_args()
    sensor = load_sensor(given.sensor).with_columns(given.columns, given.stride)
    write_streets(given.folder, sensor, given.first_seed, given.every, _NOMINAL)


if __name__ == "__main__":
    _main()

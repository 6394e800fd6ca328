"""Simulated drives as files: seeds → a tree laid out as KITTI odometry and SemanticKITTI are."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lidargrit.core import reporting
from lidargrit.core.errors import ConfigError, DataError
from lidargrit.core.files import (
    atomic_path,
    claim_folder,
    claimed_manifest,
    write_json,
)
from lidargrit.core.shares import each_done
from lidargrit.core.untrusted import FRAMES_AT_MOST
from lidargrit.data.datasets.kitti_odometry import KittiOdometry
from lidargrit.data.datasets.shared.odometry import num_poses, write_motions
from lidargrit.data.datasets.shared.streets import STREETS_VERSION
from lidargrit.data.formats.kitti_bin import KittiBin
from lidargrit.data.scan_folder import begun_by, write_sensor
from lidargrit.scans.sensors import SensorModel, load_sensor
from lidargrit.simulator import FRAME_S, Theme, check_settings, observe, poses_of

MANIFEST = "simulated.json"
_SHARE, _SHARE_ON_RAY = 4, 16  # scans: seconds of work, for a task takes a cluster 30 ms
_SCANS_PER_SEQUENCE = 10_000  # of streets seen once each: a folder that any file browser still opens


@dataclass(frozen=True)
class DriveConfig:
    """Settings of simulated drives.

    Args:
        seed: seed of the first street; each further street has the next seed.
        frames: scans of each street, 0.1 s apart; with 1, every scan shows another street. Streets of drives of more
            than 100 m go on.
        motion: whether scans keep the distortion by the car's own motion; KITTI odometry has it removed.
        wet: wetness of the ground, from 0 (dry) to 1 (soaked).
        clean: whether ``observation/NNNNNN.npz`` is written, too, from which raydrop models are trained and judged: the
            clean range of every pixel, the probability of a return, the sampled mask, reflectance and label.
    """

    sensor: SensorModel
    seed: int = 0
    frames: int = 1
    theme: Theme = "mixed"
    motion: bool = False
    wet: float = 0.0
    clean: bool = False

    def __post_init__(self) -> None:
        if not 1 <= self.frames <= FRAMES_AT_MOST:
            raise ConfigError(f"frames={self.frames}", f"1 to {FRAMES_AT_MOST:,} scans of a street", "correct it")
        check_settings(self.seed, self.theme, wet=self.wet)

    def street_of(self, scan: int) -> tuple[int, int]:
        """Return the seed of a scan's street and its frame there."""
        return self.seed + scan // self.frames, scan % self.frames

    def sequence_and_number(self, scan: int) -> tuple[str, int]:
        """Return a scan's sequence and its number in it: a drive each, or many single streets together."""
        return f"{scan // self.scans_per_sequence:02d}", scan % self.scans_per_sequence

    @property
    def scans_per_sequence(self) -> int:
        """Number of scans in a sequence."""
        return self.frames if self.frames > 1 else _SCANS_PER_SEQUENCE

    def to_json(self) -> dict[str, Any]:
        """Return all that the scans depend on."""
        return {**vars(self), "sensor": self.sensor.to_json(), "streets": STREETS_VERSION}


def write_drives(out: Path, num_scans: int, config: DriveConfig, workers: int = 1, ray: str = "") -> int:
    """Write scans, labels and poses; scans that are there already are not simulated again.

    The tree is ``sequences/SS/{velodyne/NNNNNN.bin, labels/NNNNNN.label, poses.txt, times.txt, calib.txt}``, and
    ``sensor.json`` for another sensor than KITTI's. The poses lie in ``poses/SS.txt``, too: SemanticKITTI has them in
    the sequence, KITTI's own tools look there. Streets that are seen once each are no drive: they have no times.

    Args:
        out: an empty folder, or a folder that the same simulation began; scans can be added to it.
        num_scans: total number of scans.
        workers: number of parallel processes.
        ray: address of a Ray cluster that simulates in place of processes; see :func:`each_done`.

    Returns:
        Number of scans that are there now.
    """
    with claim_folder(out), claimed_manifest(out / MANIFEST):
        _claim(out, config)
        there = max(num_scans, _last_scan(out, config) + 1)  # an earlier call may have made more
        if config.frames > 1:  # first, so that what an interrupted call leaves is drives
            _write_sequence_files(out, config, there)
        missing = [scan for scan in range(there) if not _label_file(out, config, scan).exists()]
        size = _SHARE_ON_RAY if ray else _SHARE
        shares = [missing[first : first + size] for first in range(0, len(missing), size)]
        with reporting.progress("simulating", there, there - len(missing)) as progress:
            for count in each_done(partial(_write_scans, out, config), shares, workers, ray):
                _write_sensor(out, config)
                progress.advance(count)
        if config.frames == 1:  # last, so that a sensor that sees nothing leaves the folder free
            _write_sequence_files(out, config, there)
    return there


def _claim(out: Path, config: DriveConfig) -> None:
    facts = config.to_json()
    other = "which holds scans simulated in another way"
    if begun_by(out / MANIFEST, lambda there: "" if there == facts else other) is None:
        write_json(out / MANIFEST, facts)


def _write_sensor(out: Path, config: DriveConfig) -> None:
    """Write the sensor, unless it is the one that readers of such trees take."""
    if config.sensor.to_json() != load_sensor(KittiOdometry.sensor).to_json():
        write_sensor(out, config.sensor)


def _write_scans(out: Path, config: DriveConfig, scans: Sequence[int]) -> int:
    """Write those scans that are not there, and return how many are then."""
    for scan in scans:
        if not _label_file(out, config, scan).exists():
            _write_scan(out, config, scan)
    return len(scans)


def _write_scan(out: Path, config: DriveConfig, scan: int) -> None:
    """Write one scan's files; its labels come last and say that the others are there."""
    seed, frame = config.street_of(scan)
    settings = {"theme": config.theme, "motion": config.motion, "wet": config.wet}
    seen = observe(seed, config.sensor, frame=frame, frames=config.frames, **settings)
    if not seen.return_mask.any():
        raise DataError(
            f"no return in the simulated street {seed} by the sensor {config.sensor.name!r}",
            "rays that meet the street within the sensor's range limits",
            "choose another sensor",
        )
    points = seen.scan(f"simulated scan {seed}")
    assert points.label is not None
    label_file = _label_file(out, config, scan)
    folder, name = label_file.parent.parent, label_file.stem
    KittiBin.write(folder / "velodyne" / f"{name}.bin", points)
    if config.clean:
        with atomic_path(folder / "observation" / f"{name}.npz") as temporary, temporary.open("wb") as file:
            np.savez_compressed(
                file,
                clean_range_m=seen.clean_range_m,
                return_probability=seen.return_probability.astype(np.float16),
                return_mask=seen.return_mask,
                range_m=seen.range_m,
                reflectance=seen.reflectance,
                label=seen.label,
                cos_incidence=seen.cos_incidence.astype(np.float16),
            )
    with atomic_path(label_file) as temporary:
        temporary.write_bytes(points.label.numpy().astype("<u4").tobytes())


def _label_file(out: Path, config: DriveConfig, scan: int) -> Path:
    sequence, number = config.sequence_and_number(scan)
    return out / "sequences" / sequence / "labels" / f"{number:06d}.label"


def _last_scan(out: Path, config: DriveConfig) -> int:
    """Return the last scan that is there, after which an interrupted call may have left gaps; -1 for none."""
    last = -1
    for file in out.glob("sequences/*/labels/[!.]*.label"):
        sequence, number = file.parent.parent.name, file.stem
        if sequence.isdecimal() and number.isdecimal():
            scan = int(sequence) * config.scans_per_sequence + int(number)
            if file == _label_file(out, config, scan):  # else it is a file of the user's
                last = max(last, scan)
    return last


def _write_sequence_files(out: Path, config: DriveConfig, num_scans: int) -> None:
    """Write what a sequence has once: poses, and times of a drive."""
    _write_sensor(out, config)
    scans = range(num_scans)
    if config.frames == 1:
        for first in scans[:: config.scans_per_sequence]:
            here = scans[first : first + config.scans_per_sequence]
            write_motions(out, config.sequence_and_number(first)[0], [np.eye(4)] * len(here))
        return
    with reporting.progress("planning", len(scans[:: config.frames])) as progress:
        for first in scans[:: config.frames]:
            sequence, _ = config.sequence_and_number(first)
            times_s = [FRAME_S * number for number in range(len(scans[first : first + config.frames]))]
            if num_poses(out, sequence) != len(times_s):
                way = poses_of(config.street_of(first)[0], times_s, config.sensor, config.theme)
                write_motions(out, sequence, [np.linalg.inv(way[0]) @ pose for pose in way], times_s)
            progress.advance(1)

"""nuScenes: ROOT/{samples,sweeps}/LIDAR_TOP/*.pcd.bin → scans of 1000 scenes of 20 s, in the order of time."""

import json
import re
from bisect import bisect_right
from collections.abc import Iterable, Iterator
from itertools import chain
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from lidargrit.core.errors import DataError, LidarGritError, first_words
from lidargrit.core.files import read_json, remembered
from lidargrit.data import formats
from lidargrit.data.datasets import SplitScheme
from lidargrit.data.datasets.shared.files import FileDataset, unnamed_recording
from lidargrit.data.datasets.shared.splits import Split
from lidargrit.data.formats import BadPoints
from lidargrit.scans.motion import Motion, as_poses

_TABLE_BYTES_AT_MOST = 50_000_000  # sample.json, the largest, has 9 MB
_ROW = re.compile(rb"\{[^{}]{1,4096}\}")
_FILE_FROM_SENSOR = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])  # x right, y forward
_BESIDE_US = 600_000  # sweeps before a scene's first sample or after its last one, which lie half a second apart
_LAST_SCENE = 1110
_VAL = (
    "3 12-18 35-36 38-39 92-110 221 268-278 329-332 344-346 519-524 552-565 625-627 629-630 632-638 770-771 775 "
    "777-778 780-784 794-800 802 904-917 919-931 962-963 966-969 971-972 1059-1073"
)
_TEST = (
    "77-91 111-119 140 142-148 265-266 279-282 307-314 333-343 481-498 547-551 601-604 606-624 827-831 833-842 "
    "844-846 932-933 935-943 1026-1043"
)
_MINI_TRAIN, _MINI_VAL = "61 553 655 757 796 1077 1094 1100", "103 916"


def _numbers(ranges: str) -> set[int]:
    ends = [[int(end) for end in part.split("-")] for part in ranges.split()]
    return {number for part in ends for number in range(part[0], part[-1] + 1)}


def _scenes(numbers: Iterable[int]) -> tuple[str, ...]:
    return tuple(f"scene-{number:04d}" for number in sorted(numbers))


class Nuscenes(FileDataset):
    """The scans of nuScenes' LIDAR_TOP, keyframes (2 a second) and those between (20 a second) together.

    A sequence is a scene where the tables of the data set lie beside the scans (scene.json, sample.json and log.json in
    ``v1.0-trainval``, ``v1.0-test`` or ``v1.0-mini``), and a log (a drive, the first part of a file's name) where they
    do not. The official splits are by scene and need the tables. A scan belongs to the scene of its log whose samples
    surround it in time; scans of no scene make a sequence of their log. A folder of .pcd.bin alone is read, too;
    a file ``sensor.json`` in it describes another sensor.

    The scans are corrected for the car's motion, which lifts near points out of their rows by a degree: rows by ring
    (``--set data.projection=unfolding``) hold them all, rows by elevation leave an arc of the ground empty.

    Source:
        Caesar et al., CVPR 2020; lists of scenes: nutonomy/nuscenes-devkit@0334132, python-sdk/nuscenes/utils/splits.py
        (850 of train and val, 150 of test; train is written here as what is in neither of the others).
    """

    title = "nuScenes"
    licence = "CC BY-NC-SA 4.0 with terms of use of its own (non-commercial)"
    tree = "ROOT/{samples,sweeps}/LIDAR_TOP/*.pcd.bin with ROOT/v1.0-*/{scene,sample,log}.json"
    sensor = "hdl32e"
    format = "nuscenes_bin"
    citation = "Caesar et al.: nuScenes, CVPR 2020"
    schemes: ClassVar[dict[str, SplitScheme]] = {
        "official": SplitScheme(
            source="nutonomy/nuscenes-devkit, the program",
            leak="Over 80 % of val and test lie within 5 m of a place in train (Lilja et al., CVPR 2024); mini_train's "
            "scenes 0553 and 0796 are in val.",
            parts={
                "train": _scenes(set(range(1, _LAST_SCENE + 1)) - _numbers(_VAL) - _numbers(_TEST)),
                "val": _scenes(_numbers(_VAL)),
                "test": _scenes(_numbers(_TEST)),
                "mini_train": _scenes(_numbers(_MINI_TRAIN)),
                "mini_val": _scenes(_numbers(_MINI_VAL)),
            },
        )
    }
    patterns = ("s[aw]*/LIDAR_TOP/*.pcd.bin", "LIDAR_TOP/*.pcd.bin", "*.pcd.bin")

    def __init__(self, root: Path, split: str = "all", bad_points: BadPoints = "refuse") -> None:
        self._scenes_of_log = _read_scenes(root)
        super().__init__(root, split, bad_points)
        self.sensor = self._sensor_beside()

    def name(self, index: int) -> str:
        """Name one scan by its file, which has its log and its time."""
        return formats.stem(self.path(index))

    def sequence_of(self, relative: Path) -> str:
        """Name the scene of a file, or its log where the tables do not say."""
        log, time_us = _log_and_time(relative)
        scenes = self._scenes_of_log.get(log, [])
        last = bisect_right(scenes, time_us + _BESIDE_US, key=lambda scene: scene[0]) - 1
        near = [scene for scene in scenes[max(last - 1, 0) : last + 1] if time_us <= scene[1] + _BESIDE_US]
        return min(near, key=lambda scene: max(scene[0] - time_us, time_us - scene[1], 0))[2] if near else log

    def motion(self, index: int) -> Motion:
        """Return time and pose of a scan, by its file's name and the tables of the car's and the sensor's poses."""
        path = self.path(index)
        _, time_us = _log_and_time(path)
        pose = _poses(self.root).get(path.name)
        return Motion(time_us / 1e6 if time_us else None, None if pose is None else torch.from_numpy(pose))

    def recording_of(self, path: Path) -> str:
        """Name the log of a file: scenes are cut from it."""
        log, _ = _log_and_time(path)
        return unnamed_recording(path) if log == "." else f"nuscenes/{log}"

    def _find(self) -> list[Path]:
        return sorted(super()._find(), key=lambda path: path.name)  # both folders together in the order of time

    def _none_of(self, split: Split, sequences: set[str], wanted: list[str]) -> DataError:
        if self._scenes_of_log or not wanted[0].startswith("scene-"):
            return super()._none_of(split, sequences, wanted)
        return DataError(
            f"the split {split.text!r} of {self.root} without the tables that tell which scan is of which scene",
            f"scene.json, sample.json and log.json in {self.root / 'v1.0-*'}",
            f"unpack the data set's metadata there, or choose logs: {'+'.join(sorted(sequences)[:2])}",
        )


def _log_and_time(path: Path) -> tuple[str, int]:
    """Take n008-2018-08-01-15-16-36-0400__LIDAR_TOP__1533151603597909 apart; "." if a file is not called like that."""
    log, _, time = path.name.removesuffix(".pcd.bin").partition("__LIDAR_TOP__")
    return (log, int(time)) if time.isascii() and time.isdecimal() and len(time) < 20 else (".", 0)


def _read_scenes(root: Path) -> dict[str, list[tuple[int, int, str]]]:
    """Return the first and the last sample's time (in microseconds) and the name of each scene of every log."""
    logs: dict[str, list[tuple[int, int, str]]] = {}
    for table in sorted(root.glob("v1.0-*/scene.json")):
        try:
            times: dict[str, list[int]] = {}
            for sample in _read_table(table.with_name("sample.json")):
                times.setdefault(sample["scene_token"], []).append(int(sample["timestamp"]))
            log_files = {log["token"]: log["logfile"] for log in _read_table(table.with_name("log.json"))}
            for scene in _read_table(table):
                if known := times.get(scene["token"]):
                    span = (min(known), max(known), str(scene["name"]))
                    logs.setdefault(log_files[scene["log_token"]], []).append(span)
        except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
            what = error.got[:200] if isinstance(error, LidarGritError) else first_words(error)
            raise DataError(
                f"{table.parent}, whose tables cannot be used ({what})",
                "scene.json, sample.json and log.json as nuScenes has them",
                "unpack the data set's metadata again, or move that folder away to go by logs",
            ) from None
    return {log: sorted(set(scenes)) for log, scenes in logs.items()}


def _read_table(path: Path) -> list[dict[str, Any]]:
    return read_json(path, list, DataError, "a table of nuScenes", "unpack it again", _TABLE_BYTES_AT_MOST)


def _tables_of_poses(root: Path) -> list[list[Path]]:
    names = ("sample_data.json", "ego_pose.json", "calibrated_sensor.json")
    return [[table.with_name(name) for name in names] for table in sorted(root.glob("v1.0-*/sample_data.json"))]


@remembered(lambda root: chain.from_iterable(_tables_of_poses(root)), at_most=4)
def _poses(root: Path) -> dict[str, Float64[np.ndarray, "4 4"]]:
    """Return the pose of LIDAR_TOP at each scan by its file's name; none without the tables.

    Those of the whole data set have 2 GB: they are read row by row, and rows of cameras and radars left out.
    """
    found = dict[str, Float64[np.ndarray, "4 4"]]()
    for table, *of_poses in _tables_of_poses(root):
        try:
            scans = [row for row in _rows(table) if "/LIDAR_TOP/" in row["filename"]]
            wanted = {row[name] for row in scans for name in ("ego_pose_token", "calibrated_sensor_token")}
            rows = (row for of in of_poses for row in _rows(of) if row["token"] in wanted)
            poses = {row["token"]: _matrix(row) for row in rows}
            for row in scans:
                pose = poses[row["ego_pose_token"]] @ poses[row["calibrated_sensor_token"]] @ _FILE_FROM_SENSOR
                found[Path(row["filename"]).name] = pose
        except (KeyError, TypeError, ValueError, OSError) as error:
            got = f"{table.parent}, whose poses cannot be used ({str(error)[:100]})"
            raise DataError(got, "sample_data, ego_pose and calibrated_sensor", "unpack the metadata again") from None
    return found


def _rows(table: Path) -> Iterator[dict[str, Any]]:
    if not table.is_file():  # a pipe would hang
        raise OSError(f"no file {table.name}")
    with table.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as content:
        for row in _ROW.finditer(content):
            yield json.loads(row[0])


def _matrix(row: dict[str, Any]) -> Float64[np.ndarray, "4 4"]:
    w, x, y, z = row["rotation"]
    pose = as_poses(Rotation.from_quat((x, y, z, w)).as_matrix(), np.array(row["translation"], np.float64))
    if not np.isfinite(pose).all():
        raise ValueError("a number that is not finite")
    return pose

"""Which recording a scan was cut from, in whichever data set it lies, and the labels that lie beside scans of KITTI."""

import os

import numpy as np
import pytest
import torch

from lidargrit.core.errors import ScanError
from lidargrit.data.datasets import open_dataset


def put(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.tobytes())
    return path


def test_kitti_odometry_reads_labels_and_keeps_them_with_their_points(tmp_path):
    rows = np.array([[1, 2, 3, 0.5], [0, 0, 0, 0], [np.nan, 1, 1, 0], [4, 5, 6, 1]], "<f4")
    put(tmp_path / "sequences/00/velodyne/000000.bin", rows)
    put(tmp_path / "sequences/00/velodyne/000001.bin", rows[[0, 3]])
    put(tmp_path / "sequences/00/labels/000000.label", np.array([40, 1, 2, 252 + (7 << 16)], "<u4"))
    dropping = open_dataset(str(tmp_path), bad_points="drop")
    label = dropping.scan(0).label
    assert label.dtype == torch.int64
    assert label.tolist() == [40, 252 + (7 << 16)]
    assert dropping.scan(1).label is None
    put(tmp_path / "sequences/00/labels/000001.label", bytes(7))
    with pytest.raises(ScanError, match=r"7 bytes of labels in .*000001\.label, and 2 points .*; wanted .*: 8 bytes"):
        dropping.scan(1)


def test_recordings_are_known_across_data_sets(tmp_path):
    row = np.array([[1, 2, 3, 0.5]], "<f4")
    put(tmp_path / "odometry/sequences/00/velodyne/000000.bin", row)
    put(tmp_path / "odometry/sequences/11/velodyne/000000.bin", row)
    put(tmp_path / "raw/2011_10_03/2011_10_03_drive_0027_sync/velodyne_points/data/0000000000.bin", row)
    put(tmp_path / "360/data_3d_raw/2013_05_28_drive_0003_sync/velodyne_points/data/0000000000.bin", row)
    put(tmp_path / "mine/a.bin", row)
    odometry, raw = (open_dataset(str(tmp_path / name)) for name in ("odometry", "raw"))
    assert odometry.recording(0) == raw.recording(0) == "kitti/2011_10_03_drive_0027"
    assert odometry.recording(1) == "kitti_odometry/11"
    assert open_dataset(str(tmp_path / "360")).recording(0) == "kitti_360/0003"
    os.symlink(tmp_path / "mine", tmp_path / "yours")
    assert open_dataset(str(tmp_path / "yours")).recording(0) == open_dataset(str(tmp_path / "mine")).recording(0)
    one, other = open_dataset("simulated:2"), open_dataset("simulated:2:val")
    assert len({one.recording(0), one.recording(1), other.recording(0)}) == 3

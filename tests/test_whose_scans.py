"""Whose scans a folder holds: drives under two names, and layouts of KITTI that other sensors filled."""

import numpy as np
import pytest

from lidargrit.cli import main
from lidargrit.datasets import data_set_and_split, open_dataset
from lidargrit.sensors import load_sensor
from lidargrit.sources import open_source
from street_corner import corner, xyz_of

HDL64E = load_sensor("hdl64e_kitti_odometry")
KITTI_360 = "data_3d_raw/2013_05_28_drive_{}_sync/velodyne_points/data/{:010d}.bin"


def write_bin(path, seed, sensor=None):
    path.parent.mkdir(parents=True, exist_ok=True)
    table = corner(seed, sensor)
    path.write_bytes(np.c_[xyz_of(table).numpy(), table["intensity"] / 255].astype("<f4").tobytes())


def scored(first, second, capsys, *more):
    words = ["--intervals", "0", "--metrics", "range_histogram_per_ring", *more]
    assert main(["evaluate", str(first), str(second), *words]) == 0
    output = capsys.readouterr()
    return output.out + output.err


def test_drive_0018_of_kitti_360_is_told_as_0002(tmp_path, capsys):
    for at in range(2):
        write_bin(tmp_path / KITTI_360.format("0018", at), at, HDL64E)
        write_bin(tmp_path / KITTI_360.format("0002", 4391 + at), at + 50, HDL64E)
    both = open_dataset(f"kitti_360:{tmp_path}:0018+0002")
    assert {both.recording(index) for index in range(4)} == {"kitti_360/0002"}
    assert both.name(3) == "0018/0000000001"
    sources = [f"kitti_360:{tmp_path}:{drive}" for drive in ("0018", "0002")]
    assert "overlap (both have scans of kitti_360/0002)" in scored(*sources, capsys, "--set", "data.columns=90")


LAYOUTS = {
    "kitti_odometry": "sequences/00/velodyne/{:06d}.bin",
    "kitti_360": KITTI_360.replace("{}", "0003"),
    "kitti_object": "training/velodyne/{:06d}.bin",
    "kitti_raw": "2011_09_26/2011_09_26_drive_0001_sync/velodyne_points/data/{:010d}.bin",
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_layout_of_kitti_with_another_sensor_is_a_folder(tmp_path, layout):
    write_bin(tmp_path / "own" / LAYOUTS[layout].format(0), 0)
    write_bin(tmp_path / "kitti" / LAYOUTS[layout].format(0), 0, HDL64E)
    own, kitti = (open_dataset(str(tmp_path / name)) for name in ("own", "kitti"))
    assert own.public_name() == kitti.public_name() == layout
    assert data_set_and_split(str(tmp_path / "own")) == ("folder", "")
    assert data_set_and_split(str(tmp_path / "kitti")) == (layout, "all")
    assert open_source(str(tmp_path / "own")).data_set == "folder"
    assert own.recording(0).startswith("#")
    assert not kitti.recording(0).startswith("#")


def test_own_drives_in_the_layout_of_kitti_do_not_overlap(tmp_path, capsys):
    for name, seed in (("a", 0), ("b", 40)):
        for at in range(2):
            write_bin(tmp_path / name / LAYOUTS["kitti_odometry"].format(at), seed + at)
    more = ("--sensor", "vlp16", "--set", "data.columns=90")
    assert "overlap" not in scored(tmp_path / "a", tmp_path / "b", capsys, *more)

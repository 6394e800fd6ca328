"""Simulated drives as files: every reader's tree, labels and poses that fit the points, taken up where stopped."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidargrit.cli import main
from lidargrit.core.errors import ConfigError, OutputError
from lidargrit.data import drives
from lidargrit.data.datasets import data_set_and_split, open_dataset
from lidargrit.data.drives import DriveConfig, write_drives
from lidargrit.data.export import export_scans
from lidargrit.data.sources import open_source
from lidargrit.scans.sensors import load_sensor
from lidargrit.simulator import simulate

SENSOR = replace(load_sensor("vlp16").with_columns(360), name="a small sensor")


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("drive")
    write_drives(folder, 6, DriveConfig(SENSOR, seed=6, frames=3, clean=True))
    return folder


def files(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_what_an_interrupted_simulation_leaves_are_drives(tmp_path, monkeypatch):
    config = DriveConfig(SENSOR, seed=6, frames=3)

    def stopped(do, shares, *others):
        do(shares[0][:2])
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(drives, "each_done", stopped)
        with pytest.raises(KeyboardInterrupt):
            write_drives(tmp_path, 5, config)
    (window,) = open_dataset(f"kitti_odometry:{tmp_path}").windows(2)
    write_drives(tmp_path, 5, config)
    assert [float(scan.pose[0, 3]) for scan in window.scans()] == [
        float(open_dataset(f"kitti_odometry:{tmp_path}").motion(index).pose[0, 3]) for index in range(2)
    ]
    assert len((tmp_path / "sequences" / "01" / "poses.txt").read_text().splitlines()) == 2
    write_drives(tmp_path, 6, config)  # one scan more of the second street
    assert len((tmp_path / "sequences" / "01" / "poses.txt").read_text().splitlines()) == 3


def test_its_scans_are_not_those_of_kitti(drive, tmp_path):
    """Other trees of the layout hold KITTI's drives, with KITTI's terms; ours would seem to overlap with them."""
    write_drives(tmp_path / "other", 1, DriveConfig(SENSOR, seed=99))
    export_scans(f"kitti_odometry:{drive}:01", tmp_path / "exported", "kitti_odometry")
    shutil.copytree(drive / "sequences", tmp_path / "copied" / "sequences")
    roots = {name: tmp_path / name for name in ("other", "exported", "copied")} | {"drive": drive}
    sources = {name: open_dataset(f"kitti_odometry:{root}") for name, root in roots.items()}
    assert sources["copied"].recording(0).startswith("#"), "the rows are not those of KITTI's HDL-64E"
    ours = [sources[name].recording(0) for name in ("drive", "other", "exported")] + [sources["drive"].recording(3)]
    assert len(set(ours)) == 4
    assert all(name.startswith("#") for name in ours)
    assert data_set_and_split(f"kitti_odometry:{drive}:00") == ("simulated", "")
    assert data_set_and_split(str(tmp_path / "exported")) == ("", "")
    assert data_set_and_split(f"kitti_odometry:{tmp_path / 'copied'}:00") == ("folder", "")


def test_it_reads_as_kitti_odometry_with_labels(drive):
    dataset = open_dataset(f"kitti_odometry:{drive}")
    assert [dataset.name(index) for index in range(6)] == [f"{s}/{n:06d}" for s in ("00", "01") for n in range(3)]
    direct = simulate(7, SENSOR, frame=2)
    read = dataset.scan(5)
    assert torch.equal(read.points_xyz_m, direct.points_xyz_m)
    assert read.reflectance is not None
    assert direct.reflectance is not None
    assert torch.equal(read.reflectance, direct.reflectance)
    assert read.label is not None
    assert direct.label is not None
    assert torch.equal(read.label, direct.label)
    assert {40, 48} <= set((read.label & 0xFFFF).tolist()), "road and pavement"


def test_poses_carry_points_to_where_they_were_in_the_first_frame(drive):
    sequence = drive / "sequences" / "01"
    rows = np.loadtxt(sequence / "poses.txt").reshape(-1, 3, 4)
    assert (drive / "poses" / "01.txt").read_bytes() == (sequence / "poses.txt").read_bytes()
    lines = dict(line.split(": ", 1) for line in (sequence / "calib.txt").read_text().splitlines())
    camera_from_sensor = np.vstack((np.array(lines["Tr"].split(), float).reshape(3, 4), [0, 0, 0, 1]))
    poses = [np.vstack((row, [0, 0, 0, 1])) for row in rows]
    assert np.allclose(poses[0], np.eye(4))
    assert np.allclose(np.loadtxt(sequence / "times.txt"), [0, 0.1, 0.2])
    to_first = np.linalg.inv(camera_from_sensor) @ poses[2] @ camera_from_sensor
    assert np.allclose(to_first[:3, :3] @ to_first[:3, :3].T, np.eye(3), atol=1e-7)
    moved = to_first[:3, 3]
    assert 0.3 < moved[0] < 5, "the street of this seed is driven along"
    assert np.abs(moved[1:]).max() < 0.2, "ahead"
    # The planes of the first frame's walls hold the third frame's points: compare by nearest neighbour.
    from scipy.spatial import cKDTree

    dataset = open_dataset(f"kitti_odometry:{drive}:01")
    first, third = dataset.scan(0), dataset.scan(2)
    assert first.label is not None
    assert third.label is not None
    wall, wall_later = ((scan.label & 0xFFFF) == 50 for scan in (first, third))
    there = third.points_xyz_m[wall_later].double().numpy() @ to_first[:3, :3].T + moved
    tree = cKDTree(first.points_xyz_m[wall].double().numpy())
    assert np.median(tree.query(there)[0]) < np.median(tree.query(there - 2 * moved)[0])


def test_clean_ranges_and_probabilities_lie_beside_the_scans(drive):
    with np.load(drive / "sequences" / "00" / "observation" / "000000.npz", allow_pickle=False) as opened:
        seen = {name: opened[name] for name in opened.files}
    assert seen["clean_range_m"].shape == (16, 360)
    returned = seen["return_mask"]
    assert int(returned.sum()) == len(open_dataset(f"kitti_odometry:{drive}").scan(0))
    assert (np.abs(seen["range_m"] - seen["clean_range_m"])[returned] < 0.2).mean() > 0.95
    assert seen["return_probability"][returned].mean() > seen["return_probability"][~returned].mean()


def test_what_is_there_is_kept_and_more_is_added(drive, tmp_path):
    config = DriveConfig(SENSOR, seed=6, frames=3, clean=True)
    write_drives(tmp_path / "out", 2, config)
    labels = tmp_path / "out" / "sequences" / "00" / "labels"
    (labels / "000001.label").unlink()  # as if killed before its end
    write_drives(tmp_path / "out", 6, config, workers=2)
    (labels / "000000.label").unlink()  # as if a process had gone ahead
    assert write_drives(tmp_path / "out", 1, config) == 6
    ours, whole = files(tmp_path / "out"), files(drive)
    assert ours.keys() == whole.keys()
    assert all(ours[name] == whole[name] for name in whole if not name.endswith(".npz"))
    with pytest.raises(OutputError, match="simulated in another way"):
        write_drives(drive, 6, replace(config, seed=7))
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(OutputError, match=r"holds no simulated\.json"):
        write_drives(tmp_path / "mine", 1, config)


def test_files_of_the_user_among_the_labels_are_left_alone(tmp_path):
    config = DriveConfig(SENSOR, seed=6, frames=2)
    assert write_drives(tmp_path, 1, config) == 1
    for name in (
        "00/labels/notes.label",
        "00/labels/999999.label",
        "mine/labels/000000.label",
        "7/labels/000000.label",
    ):
        (tmp_path / "sequences" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "sequences" / name).write_bytes(b"mine")
    assert write_drives(tmp_path, 2, config) == 2
    assert (tmp_path / "sequences" / "00" / "labels" / "999999.label").read_bytes() == b"mine"


def test_streets_seen_once_share_a_sequence_and_the_command_writes_them(tmp_path, capsys):
    (tmp_path / "sensor.json").write_text(json.dumps(SENSOR.to_json()))
    words = ["simulate", str(tmp_path / "out"), "-n", "2", "--sensor", str(tmp_path / "sensor.json"), "--workers", "1"]
    assert main(words) == 0
    assert "2 scans in" in capsys.readouterr().out
    assert open_source(str(tmp_path / "out")).sensor.same_rays(SENSOR)  # which the tree itself does not tell
    dataset = open_dataset(str(tmp_path / "out"))
    assert [dataset.name(index) for index in range(2)] == ["00/000000", "00/000001"]
    assert np.allclose(np.loadtxt(tmp_path / "out" / "sequences" / "00" / "poses.txt"), np.eye(4)[:3].ravel())
    for wrong in ({"frames": 0}, {"seed": -1}):
        with pytest.raises(ConfigError):
            DriveConfig(SENSOR, **wrong)
    assert main([*words[:3], "0", *words[4:]]) == 2

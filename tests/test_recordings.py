"""Drives as recordings: read back by our reader, by the library of ROS messages, and by rerun where it is installed."""

import json
from shutil import copytree

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from lidargrit.cli import main
from lidargrit.core.errors import DataError, OutputError, ScanError
from lidargrit.data.datasets import open_dataset
from lidargrit.data.export import export_scans
from lidargrit.data.formats import count_scans, read_scan
from lidargrit.data.formats.kitti_bin import KittiBin
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.recordings import KINDS, recording_of
from lidargrit.data.scan_folder import KittiTree
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import Scan
from lidargrit.simulator import simulate
from tiny_runs import contents

TIMES_S, STEP_M = (0.0, 0.15), 2.5


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    """Return a tree of two drives with labels, the second with times and poses: it turns left and moves ahead."""
    root, rng = tmp_path_factory.mktemp("drives"), np.random.default_rng(0)
    for name in ("00/000000", "00/000001", "08/000000", "08/000001"):
        points = torch.from_numpy(rng.normal(0, 9, (500, 3)).astype(np.float32))
        reflectance, label = torch.from_numpy(rng.random(500, np.float32)), torch.from_numpy(rng.integers(0, 99, 500))
        (file,) = KittiTree(root).files([name])
        KittiTree(root).write(file, Scan(points, reflectance, label=label, source=name))
    folder = root / "sequences" / "08"
    (folder / "times.txt").write_text("".join(f"{time}\n" for time in TIMES_S))
    rows = [map(float, _pose(number)[:3].ravel()) for number in range(len(TIMES_S))]
    (folder / "poses.txt").write_text("".join(" ".join(map(repr, row)) + "\n" for row in rows))
    (folder / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    return root


def _pose(number):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", 0.1 * number).as_matrix()
    pose[0, 3] = STEP_M * number
    return pose


def messages(path, topic):
    """Return the messages of a topic with their times, by the libraries alone."""
    reader = pytest.importorskip("mcap.reader")
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_FOXY)
    with path.open("rb") as file:
        found = [*reader.make_reader(file, validate_crcs=True).iter_messages(topics=[topic])]
    return [(message.log_time, store.deserialize_cdr(message.data, schema.name)) for schema, _, message in found]


def test_mcap_is_read_back_with_points_times_and_poses(drives, tmp_path):
    pytest.importorskip("mcap")
    assert export_scans(f"kitti_odometry:{drives}", tmp_path / "out", "mcap") == 2
    dataset = open_dataset(f"kitti_odometry:{drives}")
    assert json.loads((tmp_path / "out/export.json").read_text())["scans"]["08.mcap"] == "08/000000 08/000001"
    path = tmp_path / "out" / "08.mcap"
    assert count_scans(path) == 2
    for index in range(2):
        wanted, got = dataset.scan(2 + index), read_scan(path, index)
        assert torch.equal(got.points_xyz_m, wanted.points_xyz_m)
        assert torch.allclose(got.reflectance, wanted.reflectance, rtol=0, atol=1e-6)
        assert (got.time_s or 0.0) == TIMES_S[index]
    for number, (time_ns, message) in enumerate(messages(path, "/tf")):
        (stamped,) = message.transforms
        place, turn = stamped.transform.translation, stamped.transform.rotation
        assert (stamped.header.frame_id, stamped.child_frame_id) == ("map", "lidar")
        assert (
            time_ns == round(TIMES_S[number] * 1e9) == stamped.header.stamp.sec * 10**9 + stamped.header.stamp.nanosec
        )
        assert np.allclose((place.x, place.y, place.z), _pose(number)[:3, 3], atol=1e-9)
        turned = Rotation.from_quat((turn.x, turn.y, turn.z, turn.w)).as_matrix()
        assert np.allclose(turned, _pose(number)[:3, :3], atol=1e-9)
    assert len(messages(path, "/tf")) == 2
    assert messages(tmp_path / "out" / "00.mcap", "/tf") == [], "no pose is known there"
    assert [time_ns for time_ns, _ in messages(tmp_path / "out" / "00.mcap", "/lidar/points")] == [0, 100_000_000]


def test_labels_are_kept_and_a_missing_recording_is_written_as_it_was(drives, tmp_path):
    pytest.importorskip("mcap")
    words = ["export", f"kitti_odometry:{drives}:00", str(tmp_path / "out"), "--format", "mcap"]
    assert main(words) == 0
    path, before = tmp_path / "out" / "00.mcap", contents(tmp_path / "out")
    assert torch.equal(read_scan(path, 1).label, open_dataset(f"kitti_odometry:{drives}:00").scan(1).label)
    path.unlink()
    assert main(words) == 0
    assert contents(tmp_path / "out") == before


def test_unusable_scans_are_left_out_of_a_recording(drives, tmp_path):
    pytest.importorskip("mcap")
    (tmp_path / "in/sequences/00/velodyne").mkdir(parents=True)
    for number, data in enumerate((next(drives.rglob("000000.bin")).read_bytes(), b"123")):
        (tmp_path / f"in/sequences/00/velodyne/{number:06d}.bin").write_bytes(data)
    skipping = DataConfig(bad_scans="skip")
    assert export_scans(f"kitti_odometry:{tmp_path / 'in'}", tmp_path / "out", "mcap", skipping) == 1
    assert count_scans(tmp_path / "out" / "00.mcap") == 1
    (tmp_path / "in/sequences/00/velodyne/000000.bin").unlink()
    with pytest.raises(DataError, match="got no usable scan"):
        export_scans(f"kitti_odometry:{tmp_path / 'in'}", tmp_path / "none", "mcap", skipping)


@pytest.mark.parametrize("times_s", [(-0.2, -0.1), (1.5e15, 1.5e15 + 1e5)], ids=["before 0", "microseconds"])
def test_times_that_no_recording_holds_are_refused(drives, times_s, tmp_path):
    pytest.importorskip("mcap")
    copytree(drives / "sequences/08", tmp_path / "in/sequences/08")
    (tmp_path / "in/sequences/08/times.txt").write_text("".join(f"{time_s!r}\n" for time_s in times_s))
    with pytest.raises(ScanError, match=f"a time of {times_s[0]:g} s of .*000000".replace("+", r"\+")):
        export_scans(f"kitti_odometry:{tmp_path / 'in'}", tmp_path / "out", "mcap")


def test_a_missing_library_is_told_in_one_line(drives, tmp_path, monkeypatch):
    for kind, library in zip(KINDS, ("mcap", "rerun"), strict=True):
        monkeypatch.setitem(__import__("sys").modules, f"{library}.writer" if kind == "mcap" else library, None)
        with pytest.raises(OutputError, match=r"wanted it installed; pip install 'lidargrit\[(ros|rerun)\]'"):
            export_scans(f"kitti_odometry:{drives}", tmp_path / kind, kind)


def test_rerun_reads_both_kinds_back(drives, tmp_path):
    """In an environment of its own: rerun-sdk and ouster-sdk want other versions of psutil."""
    chunk = pytest.importorskip("rerun.chunk")
    dataset = open_dataset(f"kitti_odometry:{drives}:08")
    for kind in KINDS:
        export_scans(f"kitti_odometry:{drives}", tmp_path / kind, kind)
    readers = {"mcap": chunk.McapReader, "rrd": chunk.RrdReader}
    for kind, reader in readers.items():
        rows = dict[str, list]()
        for part in reader(str(tmp_path / kind / f"08.{kind}")).stream().to_chunks():
            for name, values in part.to_record_batch().to_pydict().items():
                rows.setdefault(name, []).extend(values)
        clouds = [values for values in rows["Points3D:positions"] if values]
        for index, points in enumerate(clouds):
            assert np.array_equal(np.asarray(points, np.float32), dataset.scan(index).points_xyz_m.numpy())
        places = [values[0] for values in rows["Transform3D:translation"] if values]
        assert np.allclose(places, [_pose(number)[:3, 3] for number in range(2)], atol=1e-6)
        assert len(clouds) == len(places) == 2
    turns = [np.asarray(values[0]).reshape(3, 3).T for values in rows["Transform3D:mat3x3"]]  # column after column
    assert np.allclose(turns, [_pose(number)[:3, :3] for number in range(2)], atol=1e-6)
    seconds = sorted({value.timestamp() for value in rows["time"] if value is not None})
    assert seconds == list(TIMES_S)
    assert sorted({value for value in rows["scan"] if value is not None}) == [0, 1]


def test_names_of_scans_tell_their_recording():
    names = {"00/000012": "00", "a/b/0.bin": "a/b", "drive#3": "drive", "x/drive#3": "x/drive", "000001": "."}
    names |= {"run#1/000012": "run#1", "a#b/c#d#3": "a#b/c#d", "x/#3": "x"}
    assert {name: recording_of(name) for name in names} == names


def test_drives_whose_folders_are_called_alike_are_no_single_recording(tmp_path):
    scan = simulate(0, load_sensor("vlp16").with_columns(16))
    for file in ("of/run#1/0.bin", "of/run#2/0.bin", "in/0.bin", "in/scans/0.bin"):
        KittiBin.write(tmp_path / file, scan)
    assert export_scans(str(tmp_path / "of"), tmp_path / "out", "mcap") == 2
    assert sorted(path.name for path in (tmp_path / "out").glob("*.mcap")) == ["run#1.mcap", "run#2.mcap"]
    with pytest.raises(DataError, match=r"several scans of .* that would be scans\.mcap"):
        export_scans(str(tmp_path / "in"), tmp_path / "out_of_in", "mcap")

"""PandaSet's own layout: real frames as another program put them back, and pickles that ask for what is not theirs."""

import gzip
import json
import pickle
import shutil
from io import BytesIO
from types import FunctionType
from typing import ClassVar

import numpy as np
import pytest
import torch

from lidargrit.core.errors import DataError, ScanError
from lidargrit.data.datasets import open_dataset, recognise
from lidargrit.data.formats import read_scan
from lidargrit.data.formats.shared.pandas_pickle import columns_of_table

TABLE = {name: np.arange(4.0) + number for number, name in enumerate("xyzi")} | {"t": 10 + np.arange(4) / 40}


class _Pickler(pickle._Pickler):
    """Writes names of classes and functions without looking for them: the pandas of then is not installed."""

    def save_global(self, obj, name=None):
        self.write(f"c{obj.__module__}\n{name or obj.__name__}\n".encode())
        self.memoize(obj)

    dispatch: ClassVar = {**pickle._Pickler.dispatch, FunctionType: save_global}


def _named(path, base=object):
    module, _, name = path.rpartition(".")
    return type(name, (base,), {"__module__": module, "__getstate__": lambda self: self.state})


_DataFrame, _BlockManager = _named("pandas.core.frame.DataFrame"), _named("pandas.core.internals.managers.BlockManager")


def _new_index(cls, facts):
    raise AssertionError


_new_index.__module__, _new_index.__name__ = "pandas.core.indexes.base", "_new_Index"


class _Index:
    def __init__(self, names):
        self.facts = {"data": np.array(names, dtype=object), "name": None}

    def __reduce__(self):
        return _new_index, (_named("pandas.core.indexes.base.Index"), self.facts)


def pickled(columns):
    """Return a table as pandas 0.25 pickled it: floats in one block, whole numbers in another."""
    kinds = [[name for name, values in columns.items() if values.dtype.kind == kind] for kind in "fi"]
    blocks = [np.array([columns[name] for name in names]) for names in kinds if names]
    table, manager, file = _DataFrame(), _BlockManager(), BytesIO()
    axes, names = [_Index([*columns]), _Index(["rows"])], [_Index(names) for names in kinds if names]
    manager.state = axes, blocks, names, {"0.14.1": {}}
    table.state = {"_data": manager, "_typ": "dataframe"}
    _Pickler(file, 3).dump(table)
    return file.getvalue()


def drive(folder, data):
    """Write one frame, poses of a car that goes ahead by 1 m a frame along the world's x, and times."""
    half = np.sqrt(0.5)  # of a quaternion that turns by 90 degrees to the right: y, ahead, becomes x
    poses = [
        {"position": {"x": float(at), "y": 0.0, "z": 0.0}, "heading": {"w": half, "x": 0.0, "y": 0.0, "z": -half}}
        for at in range(3)
    ]
    (folder / "001/lidar").mkdir(parents=True)
    (folder / "001/lidar/01.pkl.gz").write_bytes(gzip.compress(data))
    (folder / "001/lidar/poses.json").write_text(json.dumps(poses))
    (folder / "001/lidar/timestamps.json").write_text(json.dumps([10.0, 10.1, 10.2]))
    return folder / "001/lidar/01.pkl.gz"


@pytest.mark.parametrize(("drive_name", "frame"), [("001", 2), ("002", 1)])
def test_real_frames_are_as_another_program_put_them_back(real, drive_name, frame):
    dataset = open_dataset(f"{real / 'pandaset/original'}:{drive_name}")
    assert type(dataset).public_name() == "pandaset"
    scan, motion, known = dataset.scan(0), dataset.motion(0), real / "pandaset/sequences" / drive_name
    rows = np.fromfile(known / f"velodyne/{frame:06d}.bin", "<f4").reshape(-1, 4)
    off_m = np.linalg.norm(scan.points_xyz_m.numpy() - rows[:, :3], axis=1)
    assert off_m.max() < 0.03, "two drives were fitted alone there, by 0.02 degrees apart"
    assert np.median(off_m) < 0.004
    assert np.array_equal(scan.reflectance.numpy(), rows[:, 3])
    assert np.array_equal(scan.label.numpy(), np.fromfile(known / f"labels/{frame:06d}.label", "<u4"))
    times = np.fromfile(known / f"point_times/{frame:06d}.u16", "<u2")
    assert np.abs(scan.point_time_s.numpy() - (0.002 - 2e-6 * times)).max() < 1.2e-6
    assert abs(motion.time_s - np.loadtxt(known / "times.txt")[frame]) < 1e-6
    pose = np.loadtxt(known / "poses.txt")[frame].reshape(3, 4)
    assert np.abs(motion.pose.numpy()[:3] - pose).max() < 1e-3


def test_a_table_is_read_by_names_and_points_are_seen_from_where_the_car_was(tmp_path):
    columns = TABLE | {"x": np.array([50.0, 50, 50, 50]), "y": np.zeros(4), "z": np.full(4, 2.0)}
    columns["d"] = np.array([0, 0, 1, 0])
    path = drive(tmp_path, pickled(columns))
    assert recognise(tmp_path) == "pandaset"
    scan = read_scan(path)
    ahead_m = 50 - (columns["t"][[0, 1, 3]] - 10) / 0.1 - 0.7805  # and the sensor lies that far ahead of the pose
    assert np.allclose(scan.points_xyz_m[:, 0].numpy(), ahead_m, atol=0.02), "tilted by 0.9 degrees"
    assert np.allclose(scan.points_xyz_m[:, 1].numpy(), 0, atol=0.02)
    assert np.allclose(scan.reflectance.numpy(), columns["i"][[0, 1, 3]] / 255)
    assert np.allclose(scan.point_time_s.numpy(), columns["t"][[0, 1, 3]] - 10.1)
    motion = open_dataset(f"pandaset:{tmp_path}").motion(0)
    assert motion.time_s == pytest.approx(0.1)
    assert np.allclose(motion.pose.numpy()[:3, 3], (1, 0, 0), atol=0.02)
    bare = drive(tmp_path / "bare", pickled(columns))
    bare.with_name("poses.json").unlink()
    with pytest.raises(ScanError, match=r"poses\.json"):
        read_scan(bare)
    with pytest.raises(DataError, match=r"poses\.json"):
        open_dataset(f"pandaset:{tmp_path / 'bare'}").motion(0)


class _Runs:
    def __reduce__(self):
        return print, ("it ran",)


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (pickle.dumps(_Runs()), "asks for builtins.print"),
        (pickle.dumps(torch.Size((1,))), "asks for torch.Size"),
        (b"\x80\x03cnumpy\nload\nq\x00.", "asks for numpy.load"),
        (b"\x80\x03]r\xff\xff\xff\x7f.", "more than a table"),  # a place two thousand million up
        (b"\x80\x03" + b"]0" * 9000 + b"N.", "more than a table"),
        (b"\x80\x03X\x04\x00\x00\x00hiyaQ.", "lies elsewhere"),
        (pickle.dumps({"x": 1}), "damaged"),
    ],
)
def test_a_pickle_that_asks_for_more_is_refused_and_nothing_runs(data, why, tmp_path, capsys):
    with pytest.raises(ScanError, match=why):
        read_scan(drive(tmp_path, data))
    assert capsys.readouterr().out == ""


def test_an_array_that_claims_more_than_it_holds_is_refused():
    data = pickled(TABLE)
    assert [*columns_of_table(data)] == [*TABLE]
    shape = b"K\x05K\x04\x86"  # five rows of four
    assert shape in data
    for other in (b"K\xffK\x04\x86", b"K\x05K\xff\x86", b"J\xff\xff\xff\xffK\xec\x86"):
        with pytest.raises(ValueError, match="an array of"):
            columns_of_table(data.replace(shape, other))
    with pytest.raises(ValueError, match="an array of"):
        columns_of_table(data.replace(b"X\x02\x00\x00\x00f8", b"X\x02\x00\x00\x00O8"))


def test_damaged_frames_are_refused_in_one_line(real, tmp_path):
    shutil.copytree(real / "pandaset/original/001", tmp_path / "001", copy_function=shutil.copyfile)
    path, rng = tmp_path / "001/lidar/02.pkl.gz", np.random.default_rng(0)
    data = gzip.decompress(path.read_bytes())
    messages = []
    for number in range(10):
        damaged = bytearray(data[: 3000 if number % 2 else len(data)])
        damaged[int(rng.integers(0, 600))] = int(rng.integers(0, 256))
        path.write_bytes(gzip.compress(bytes(damaged), 0))
        try:
            read_scan(path)
        except ScanError as error:
            messages.append(str(error))
    assert len(messages) >= 5
    assert not any("\n" in line or len(line) > 600 for line in messages)

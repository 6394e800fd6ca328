"""Folders in which scans of several formats lie: which data set they are, and what their scans are called."""

import pytest
import torch

from lidargrit.data.datasets import load, open_dataset
from lidargrit.data.formats import load as load_format
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import Scan
from lidargrit.simulator import simulate


def put(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    ("name", "file"), [("argoverse2", "a.feather"), ("nuscenes", "a.pcd.bin"), ("range_images", "a.png")]
)
def test_loose_files_are_of_their_data_set_only_if_no_other_scans_lie_beside(tmp_path, name, file):
    if name == "argoverse2":
        pytest.importorskip("pyarrow")
    form, sensor = load_format(load(name).format), load_sensor(load(name).sensor)
    scan = simulate(3, sensor.with_columns(300))
    near = scan.points_xyz_m.norm(dim=1) < 60
    scan = Scan(scan.points_xyz_m[near], scan.reflectance[near], scan.ring[near])
    form.write(tmp_path / file, scan)
    (tmp_path / "picture.jpg").write_bytes(b"no scan")
    put(tmp_path / "notes.npy", b"called like a scan, but none")
    put(tmp_path / ".hidden" / "b.ply", b"ply\n")
    assert open_dataset(str(tmp_path)).public_name() == name
    (tmp_path / "notes.npy").unlink()
    load_format("ply").write(put(tmp_path / "deep" / "er" / "b.ply", b""), scan)
    mixed = open_dataset(str(tmp_path))
    assert mixed.public_name() == "folder"
    found = sorted(mixed.path(index).name for index in range(len(mixed)))
    assert found == [file, "b.ply"], "of Argoverse's two sensors the upright one alone, as in its own data set"


def test_scans_of_one_stem_keep_their_endings(tmp_path):
    scan = Scan(torch.ones(4, 3))
    for file in ("a.pcd", "a.ply", "a.ply.npy", "b.ply", "c/a.ply"):
        load_format({"pcd": "pcd", "ply": "ply", "npy": "numpy_array"}[file[-3:]]).write(
            put(tmp_path / file, b""), scan
        )
    dataset = open_dataset(str(tmp_path))
    names = [dataset.name(index) for index in range(len(dataset))]
    assert names == ["a.pcd", "a.ply", "a.ply.npy", "b", "c/a"]
    assert open_dataset(f"{tmp_path}:all[:20%]").name(0) == "a.pcd", "whatever the split"

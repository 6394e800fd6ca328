"""HDF5 files: datasets by their names, several scans, a choice where names do not tell, and nothing of hostile ones."""

import re
import subprocess
import sys
from contextlib import suppress

import numpy as np
import pytest
import torch

from lidargrit.cli import main
from lidargrit.core.errors import ScanError
from lidargrit.data.datasets import open_dataset
from lidargrit.data.formats import count_scans, read_scan
from lidargrit.data.formats.shared import hdf5_child
from lidargrit.data.sources import open_source
from lidargrit.scans.projection import project
from lidargrit.scans.sensors import load_sensor
from lidargrit.simulator import simulate
from street_corner import corner, rows_of, xyz_of

h5py = pytest.importorskip("h5py")

TABLE = corner()
POINTS, INTENSITY, RING = xyz_of(TABLE), TABLE["intensity"].astype(np.float32), TABLE["ring"]
COLUMNS = {**{axis: TABLE[axis] for axis in "xyz"}, "intensity": INTENSITY}


def written(path, datasets, **more):
    with h5py.File(path, "w") as file:
        for name, values in datasets.items():
            file.create_dataset(name, data=values, **more)
    return path


@pytest.mark.parametrize(
    "datasets",
    [
        {"points": POINTS, "intensity": INTENSITY, "ring": RING},
        {"lidar/xyz": POINTS, "lidar/intensity": INTENSITY[:, None], "pose": np.eye(4), "lidar/normals": POINTS},
        {**COLUMNS, "ring": RING},
        {**{axis.upper(): TABLE[axis] for axis in "xyz"}, "Intensity": INTENSITY, "ring": RING, "file": RING},
        {"a": np.c_[POINTS, INTENSITY, RING]},
        {"cloud": rows_of({**COLUMNS, "ring": RING})},
    ],
    ids=["by name", "in a group", "x y z", "X Y Z", "rows", "named rows"],
)
def test_points_are_found_with_what_lies_beside_them(tmp_path, datasets):
    path = written(tmp_path / "a.h5", datasets, compression="gzip")
    assert count_scans(path) == 1
    scan = read_scan(path)
    assert torch.equal(scan.points_xyz_m, POINTS)
    assert scan.reflectance is not None
    assert torch.equal(scan.reflectance, torch.from_numpy(INTENSITY / np.float32(255)))
    if "lidar/xyz" not in datasets:
        assert scan.ring is not None
        assert scan.ring.tolist() == RING.tolist()


def test_groups_of_one_name_are_scans(tmp_path):
    others = {f"{at}/points": xyz_of(corner(at)) for at in range(3)}
    dataset = open_dataset(str(written(tmp_path / "a.hdf5", {**others, "pose": np.eye(4)})))
    assert len(dataset) == 3
    for at in range(3):
        assert torch.equal(dataset.scan(at).points_xyz_m, xyz_of(corner(at)))


def test_datasets_are_named_and_can_be_chosen(tmp_path, capsys):
    path = written(tmp_path / "a.h5", {"front": POINTS, "rear": xyz_of(corner(5)), "time": np.arange(3)})
    assert main(["inspect", str(path)]) == 2
    told = capsys.readouterr().err
    assert "points perhaps in /front, /rear" in told
    cure = told.rpartition("choose one: ")[2].strip().split(", ")
    assert cure == ["a.h5:/front", "a.h5:/rear"]
    chosen = open_dataset(f"{tmp_path}/{cure[1]}")
    assert torch.equal(chosen.scan(0).points_xyz_m, xyz_of(corner(5)))
    with pytest.raises(ScanError, match=r"no dataset '/left' in .*choose one: a\.h5:/front, a\.h5:/rear$"):
        open_dataset(f"{path}:/left").scan(0)
    with pytest.raises(ScanError, match=r"no dataset of points that can be read among /image \(3, 4, 5\) in"):
        read_scan(written(tmp_path / "b.h5", {"image": np.zeros((3, 4, 5))}))
    with pytest.raises(ScanError, match=r"scan number 1 of .*a\.h5"):
        read_scan(written(tmp_path / "a.h5", {"points": POINTS}), 1)


def test_clouds_of_one_file_are_different_scans_when_they_are_prepared(tmp_path, monkeypatch):
    monkeypatch.setenv("LIDARGRIT_CACHE", str(tmp_path / "cache"))
    scans = [simulate(seed=seed) for seed in range(2)]
    path = written(tmp_path / "a.h5", {f"cloud_{at}": scan.points_xyz_m for at, scan in enumerate(scans)})
    sensor = load_sensor("hdl64e_kitti_360").with_columns(128)
    images = [open_source(f"{path}:/cloud_{at}").images(sensor) for at in range(2)]
    for scan, one in zip(scans, images, strict=True):
        assert torch.allclose(one.batch([0]).range_m[0], project(scan, sensor).range_m, atol=2e-3)
    assert "in both" not in images[0].provenance.overlap(images[1].provenance)


def test_hostile_files_give_nothing_away_and_take_no_room(tmp_path):
    secret = tmp_path / "secret"
    secret.write_bytes(POINTS.numpy().tobytes())
    written(tmp_path / "there.h5", {"points": POINTS})
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["points"] = h5py.ExternalLink("there.h5", "/points")
        file.create_dataset("raw", POINTS.shape, "f4", external=[(str(secret), 0, POINTS.numel() * 4)])
        layout = h5py.VirtualLayout(POINTS.shape, "f4")
        layout[:] = h5py.VirtualSource(str(tmp_path / "there.h5"), "points", POINTS.shape)
        file.create_virtual_dataset("virtual", layout)
        file.create_dataset("huge", (10**9, 3), "f4", chunks=(10**4, 3), compression="gzip")
    left_out = "/huge (12,000 MB, above 256 MB), /raw (in another file), /virtual (made of other datasets)"
    with pytest.raises(ScanError, match=f"no dataset of points that can be read among {re.escape(left_out)}"):
        read_scan(tmp_path / "a.h5")
    with pytest.raises(ScanError, match=r"got /raw \(in another file\).*copy its values into the file"):
        open_dataset(f"{tmp_path}/a.h5:/raw").scan(0)
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["here"] = POINTS.numpy()
    assert read_scan(tmp_path / "a.h5").notes[-1] == f"left out: {left_out}"


def test_damaged_files_are_refused(tmp_path):
    path = written(tmp_path / "a.h5", {"points": POINTS, "intensity": INTENSITY}, compression="gzip")
    data, rng = path.read_bytes(), np.random.default_rng(0)
    for cut in (8, 100, len(data) // 2):
        path.write_bytes(data[:cut])
        with pytest.raises(ScanError, match="damaged file"):
            read_scan(path)
    for _ in range(8):
        changed = np.frombuffer(data, np.uint8).copy()
        changed[rng.integers(8, len(data), 20)] = rng.integers(0, 256, 20)
        path.write_bytes(changed.tobytes())
        with suppress(ScanError):
            read_scan(path)


def test_a_good_file_is_read_below_lower_hard_limits(tmp_path):
    path = written(tmp_path / "a.h5", {"points": POINTS})
    child = [sys.executable, hdf5_child.__file__, str(path), "", "-1"]
    lower = "import os, resource, sys; resource.setrlimit(resource.RLIMIT_AS, (2_900_000_000,) * 2); "
    words = [sys.executable, "-c", lower + "os.execv(sys.executable, [sys.executable, *sys.argv[1:]])", *child[1:]]
    done = subprocess.run(words, capture_output=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, b"1\n", b"")


@pytest.mark.parametrize(
    ("program", "told"),
    [
        ("import sys; sys.exit('MemoryError')", r"failed \(MemoryError\)"),
        ("import os; os.abort()", r"failed \(signal 6\)"),
        ("print('{'); raise SystemExit(3)", "an answer that is none"),
        ("print('[1, 2]'); raise SystemExit(4)", "an answer that is none"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGALRM)", "takes over 60 s"),
        ("import os; assert 'SECRET' not in os.environ; raise SystemExit('none')", r"failed \(none\)"),
    ],
)
def test_a_reader_that_fails_makes_no_file_a_damaged_one(tmp_path, monkeypatch, program, told):
    path = written(tmp_path / "a.h5", {"points": POINTS})
    (tmp_path / "reader.py").write_text(program)
    monkeypatch.setattr(hdf5_child, "__file__", str(tmp_path / "reader.py"))
    monkeypatch.setenv("SECRET", "1")
    with pytest.raises(ScanError, match=told) as caught:
        read_scan(path)
    assert "remove it" not in str(caught.value)
    assert "damaged" not in str(caught.value)

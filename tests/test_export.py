"""Exported scans: read back by other libraries and by our readers, resumed, and never written over what is not ours."""

import json
import os
import re
import signal
from pathlib import Path

import numpy as np
import pytest
import torch

from lidargrit.cli import main
from lidargrit.core.errors import ConfigError, DataError, OutputError, ScanError, UnknownNameError
from lidargrit.data.datasets import open_dataset
from lidargrit.data.datasets.shared.files import SENSOR_FILE
from lidargrit.data.export import MANIFEST, export_scans
from lidargrit.data.formats import read_scan
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.prepared.prepare import prepare
from lidargrit.data.scan_folder import KittiTree
from lidargrit.data.sources import open_images, open_source
from lidargrit.scans.motion import Motion
from lidargrit.scans.projection import unproject
from lidargrit.scans.sensors import load_sensor
from tiny_runs import contents

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(512, 8)


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    """Return a folder as ``lidargrit sample`` writes it, of two scans with reflectance."""
    folder = tmp_path_factory.mktemp("samples")
    (folder / "samples.json").write_text(
        json.dumps({"weights_sha256": "a", "sampling": {}, "sensor": SENSOR.to_json()}), encoding="utf-8"
    )
    for seed in range(2):
        rng = np.random.default_rng(seed)
        range_m = rng.uniform(2, 60, (64, 64)).astype(np.float32) * (rng.random((64, 64)) < 0.8)
        reflectance = rng.random((64, 64)).astype(np.float32) * (range_m > 0)
        np.savez(folder / f"{seed:08d}.npz", range_m=range_m.astype(np.float32), reflectance=reflectance)
    return folder


@pytest.fixture(scope="module")
def streets(tmp_path_factory):
    """Return two simulated scans as a source with labels, written once."""
    folder = tmp_path_factory.mktemp("streets") / "tree"
    assert export_scans("simulated:2:val", folder, "kitti_odometry") == 2
    return f"kitti_odometry:{folder}"


def by_library(path):
    """Read x, y, z, and the other columns by their names, without our readers."""
    if path.suffix == ".bin":
        rows = np.fromfile(path, dtype="<f4").reshape(-1, 4)
        return rows[:, :3], {"intensity": rows[:, 3]}
    if path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as opened:
            return opened["points"], {name: opened[name] for name in opened.files if name != "points"}
    if path.suffix == ".pcd":
        from pypcd4.pypcd4 import PointCloud

        data = PointCloud.from_path(path).pc_data
        return np.stack([data[axis] for axis in "xyz"], axis=1), {name: data[name] for name in data.dtype.names}
    if path.suffix == ".las":
        import laspy

        cloud = laspy.read(path)
        columns = {name: np.asarray(cloud[name]) for name in cloud.point_format.extra_dimension_names}
        return np.asarray(cloud.xyz), {**columns, "intensity": np.asarray(cloud.intensity) / 65_535}
    import trimesh

    cloud = trimesh.load(path)
    rows = cloud.metadata["_ply_raw"]["vertex"]["data"]
    return np.asarray(cloud.vertices), {name: rows[name] for name in rows.dtype.names}


def test_an_export_that_was_killed_leaves_nothing_half_written(samples, tmp_path):
    """Killed when its list, its sensor and its first scan are written, and its second has no name yet."""
    words = ["export", str(samples), str(tmp_path / "tree"), "--format", "kitti_odometry"]
    child = os.fork()
    if not child:
        calls = iter(range(9))
        os.fsync = lambda _: os.kill(os.getpid(), signal.SIGKILL) if next(calls) == 3 else None
        os._exit(main(words))
    assert os.waitpid(child, 0)[1] == signal.SIGKILL
    assert [path.suffix for path in (tmp_path / "tree").rglob("*") if path.is_file()].count(".partial") == 1
    assert len(open_dataset(f"kitti_odometry:{tmp_path / 'tree'}")) == 1, "readers take nothing half-written for a scan"
    assert main(words) == 0
    assert main([*words[:2], str(tmp_path / "whole"), *words[3:]]) == 0
    assert contents(tmp_path / "tree") == contents(tmp_path / "whole")


@pytest.mark.parametrize("kind", ["kitti_bin", "npz", "pcd", "ply", "las"])
def test_other_libraries_and_we_read_the_points_of_samples(samples, tmp_path, kind):
    assert export_scans(str(samples), tmp_path / "out", kind) == 2
    images = open_images(str(samples))
    files = sorted(path for path in (tmp_path / "out").iterdir() if path.name not in (MANIFEST, SENSOR_FILE))
    assert [path.stem for path in files] == ["000000", "000001"]
    for index, path in enumerate(files):
        wanted = unproject(images.batch([index])[0])
        near_m = 0.00005 + 1e-9 if kind == "las" else 0.0  # half a step
        points, columns = by_library(path)
        assert np.abs(points - wanted.points_xyz_m.numpy()).max() <= near_m
        assert np.abs(columns["intensity"] - wanted.reflectance.numpy()).max() < 1e-5
        back = read_scan(path)
        assert torch.allclose(back.points_xyz_m, wanted.points_xyz_m, rtol=0, atol=near_m + 1e-5 * bool(near_m))
        assert torch.allclose(back.reflectance, wanted.reflectance, rtol=0, atol=1e-5)
        if kind != "kitti_bin":
            assert np.array_equal(columns["ring"], wanted.ring.numpy())
            assert torch.equal(back.ring, wanted.ring)


def test_samples_of_another_program_are_exported_with_the_points_of_their_rays(tmp_path):
    tensor = torch.zeros(5, 64, 1024)  # as R2DM writes them: range, x, y, z, reflectance
    tensor[0, 10:, ::2], tensor[4, 10:, ::2] = 12.5, 0.25
    (tmp_path / "r2dm").mkdir()
    torch.save(tensor, tmp_path / "r2dm" / "samples_0000000000.pth")
    assert export_scans(str(tmp_path / "r2dm"), tmp_path / "out", "ply") == 1
    back = read_scan(tmp_path / "out" / "000000.ply")
    rays = load_sensor("hdl64e_kitti_360").ray_directions()[10:, ::2].reshape(-1, 3)
    assert torch.allclose(back.points_xyz_m, 12.5 * rays, rtol=0, atol=1e-5)
    assert bool((back.reflectance == 0.25).all())


@pytest.mark.parametrize("kind", ["npz", "pcd", "ply", "las"])
def test_labels_of_scans_are_kept(streets, tmp_path, kind):
    export_scans(streets, tmp_path, kind, DataConfig(max_scans=1))
    wanted = open_dataset(streets).scan(0)
    path = tmp_path / "00" / f"000000.{kind}"
    points, columns = by_library(path)
    assert np.abs(points - wanted.points_xyz_m.numpy()).max() <= 0.0000501
    assert np.array_equal(columns["label"], wanted.label.numpy())
    assert torch.equal(read_scan(path).label, wanted.label)


def test_a_tree_is_read_back_as_kitti_odometry_with_labels(streets):
    simulated, tree = open_dataset("simulated:2:val"), open_dataset(streets)
    assert [tree.name(index) for index in range(2)] == ["00/000000", "00/000001"]
    for index in range(2):
        wanted, got = simulated.scan(index), tree.scan(index)
        assert torch.equal(got.points_xyz_m, wanted.points_xyz_m)
        assert torch.equal(got.reflectance, wanted.reflectance)
        assert torch.equal(got.label, wanted.label)


def test_a_tree_keeps_the_numbers_of_a_tree_and_numbers_folders(streets, samples, tmp_path):
    export_scans(f"{streets}:all[50%:]", tmp_path / "half", "kitti_odometry")
    assert open_dataset(f"kitti_odometry:{tmp_path / 'half'}").name(0) == "00/000001"
    for number, folder in enumerate(("b", "a")):
        export_scans(str(samples), tmp_path / "drives" / folder, "ply", DataConfig(max_scans=number + 1))
    export_scans(f"folder:{tmp_path / 'drives'}", tmp_path / "tree", "kitti_odometry")
    tree = open_dataset(f"kitti_odometry:{tmp_path / 'tree'}")
    assert [tree.name(index) for index in range(len(tree))] == ["00/000000", "00/000001", "01/000000"]
    assert KittiTree(tmp_path).files(["99/000000", "100/000007"])[1] == "sequences/100/velodyne/000007.bin"
    assert not list((tmp_path / "tree").rglob("labels")), "there are none"


def test_prepared_scans_are_exported_with_the_points_of_their_pixels(streets, tmp_path):
    sensor = load_sensor("hdl64e_kitti_odometry")
    prepare(streets, DataConfig(workers=1), tmp_path / "prepared", sensor=sensor)
    assert export_scans(str(tmp_path / "prepared"), tmp_path / "out", "bin") == 2
    wanted = unproject(open_images(str(tmp_path / "prepared")).batch([1])[0])
    assert torch.equal(read_scan(tmp_path / "out" / "000001.bin").points_xyz_m, wanted.points_xyz_m)
    manifest = json.loads((tmp_path / "out" / MANIFEST).read_text(encoding="utf-8"))["scans"]
    assert sorted(manifest) == ["000000.bin", "000001.bin"]
    assert all(scan.endswith(f"velodyne/{file}") for file, scan in manifest.items())


@pytest.mark.parametrize("kind", ["prepared", "npy"])
def test_fewer_scans_have_the_names_that_they_have_among_all(kind, tmp_path):
    """So that the others can be added: every second scan is number 0 and 2, not 0 and 1."""
    sensor = load_sensor("hdl64e_kitti_odometry")
    prepare("simulated:4:val", DataConfig(), tmp_path / "prepared", sensor=sensor)
    source = tmp_path / "prepared"
    if kind == "npy":
        source = tmp_path / "arrays"
        source.mkdir()
        for index, range_m in enumerate(open_images(str(tmp_path / "prepared")).batch(range(4)).range_m):
            np.save(source / f"{index:06d}.npy", range_m[:, ::8].numpy())
    whole = {name: of for name, of in contents_of_export(source, tmp_path / "whole", 0).items() if name != MANIFEST}
    some = contents_of_export(source, tmp_path / "out", 2)
    assert sorted(some) == ["000000.bin", "000002.bin", MANIFEST, SENSOR_FILE]
    assert some["000002.bin"] == whole["000002.bin"]
    assert contents_of_export(source, tmp_path / "out", 0).keys() == {*whole, MANIFEST}


def contents_of_export(source, out, max_scans):
    export_scans(str(source), out, "bin", DataConfig(max_scans=max_scans))
    return {path.name: path.read_bytes() for path in out.iterdir()}


def test_the_same_command_goes_on_and_adds(samples, tmp_path):
    out = tmp_path / "out"
    assert export_scans(str(samples), out, "ply", DataConfig(max_scans=1)) == 1
    (out / "000000.ply").write_bytes(b"ours, and not written again")
    assert export_scans(str(samples), out, "ply") == 2
    assert (out / "000000.ply").read_bytes() == b"ours, and not written again"
    (out / "000000.ply").unlink()
    assert export_scans(str(samples), out, "ply", DataConfig(max_scans=1)) == 1
    assert len(read_scan(out / "000000.ply")) > 1000
    assert len(json.loads((out / MANIFEST).read_text(encoding="utf-8"))["scans"]) == 2
    assert sorted(path.name for path in out.iterdir()) == ["000000.ply", "000001.ply", MANIFEST, SENSOR_FILE]
    assert open_source(str(out)).sensor.same_rays(open_images(str(samples)).sensor)


def test_what_is_not_ours_is_left_alone(samples, tmp_path):
    (tmp_path / "000000.ply").write_bytes(b"somebody's")
    with pytest.raises(OutputError, match="not empty and holds no export"):
        export_scans(str(samples), tmp_path, "ply")
    out = tmp_path / "out"
    export_scans(str(samples), out, "ply")
    with pytest.raises(OutputError, match=r"export\.json has another 'format'"):
        export_scans(str(samples), out, "pcd")
    with pytest.raises(OutputError, match=r"export\.json has another '"):
        export_scans("simulated:1", out, "ply")
    about = json.loads((samples / "samples.json").read_text(encoding="utf-8"))
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "samples.json").write_text(json.dumps({**about, "weights_sha256": "b"}), encoding="utf-8")
    (tmp_path / "new" / "00000000.npz").write_bytes((samples / "00000000.npz").read_bytes())
    manifest = json.loads((out / MANIFEST).read_text(encoding="utf-8"))
    (out / MANIFEST).write_text(json.dumps({**manifest, "source": str(tmp_path / "new")}), encoding="utf-8")
    with pytest.raises(OutputError, match=r"000000\.ply is another scan"):
        export_scans(str(tmp_path / "new"), out, "ply")
    assert (tmp_path / "000000.ply").read_bytes() == b"somebody's"


@pytest.mark.parametrize("below", ["", "out", "a/b"])
def test_a_folder_in_the_source_is_refused_where_its_scans_would_be_read_again(samples, streets, tmp_path, below):
    drives = tmp_path / "drives"
    export_scans(str(samples), drives, "ply")
    (tmp_path / "link").symlink_to(drives)
    for out in (drives / below, tmp_path / "link" / below):
        with pytest.raises(OutputError, match=r"lies in .* would be read as further scans"):
            export_scans(str(drives), out, "pcd")
        run = ["complete", str(drives), str(out), "--observed", "rows:4", "--model", "nearest"]
        assert main(run) == 2
    assert len(open_dataset(str(drives))) == 2
    tree = Path(streets.partition(":")[2])
    export_scans(streets, tree / f"out_{below.replace('/', '_')}", "ply")  # its layout says where scans are
    assert len(open_dataset(streets)) == 2


def test_images_of_another_projection_are_exported_as_they_are(tmp_path, capsys):
    prepared = prepare("simulated:1", DataConfig(projection_variant="reference", columns=256), tmp_path / "prepared")
    assert export_scans(str(prepared), tmp_path / "out", "npz") == 1
    assert main(["view", str(prepared), "-o", str(tmp_path / "view.png"), "-n", "1"]) == 0


def test_bad_scans_are_refused_or_left_out(samples, tmp_path):
    scans = tmp_path / "scans"
    export_scans(str(samples), scans, "bin")
    (scans / "000000.bin").write_bytes(b"no scan at all, of an odd length")
    with pytest.raises(ScanError, match=r"000000\.bin"):
        export_scans(str(scans), tmp_path / "out", "ply")
    assert export_scans(str(scans), tmp_path / "out", "ply", DataConfig(bad_scans="skip")) == 1
    assert list(json.loads((tmp_path / "out" / MANIFEST).read_text(encoding="utf-8"))["scans"]) == ["000001.ply"]
    (scans / "000001.bin").unlink()
    with pytest.raises(DataError, match="no usable scan"):
        export_scans(str(scans), tmp_path / "none", "ply", DataConfig(bad_scans="skip"))


@pytest.mark.parametrize("bad_scans", ["refuse", "skip"])
def test_an_export_of_no_scan_leaves_the_folder_to_a_corrected_command(samples, tmp_path, bad_scans):
    scans, out, ours = tmp_path / "scans", tmp_path / "out", tmp_path / "ours"
    export_scans(str(samples), scans, "bin")
    good = {path: path.read_bytes() for path in scans.glob("*.bin")}
    for path in good:
        path.write_bytes(b"no scan at all, of an odd length")
    ours.mkdir()
    for folder in (out, ours):
        with pytest.raises((DataError, ScanError)):
            export_scans(str(scans), folder, "ply", DataConfig(bad_scans=bad_scans))
    assert not out.exists()
    assert not list(ours.iterdir())
    for path, data in good.items():
        path.write_bytes(data)
    assert export_scans(str(scans), ours, "pcd") == 2
    for path in (*good, *ours.glob("*.pcd")):
        path.write_bytes(b"no scan at all, of an odd length")
    (ours / "000000.pcd").unlink()
    with pytest.raises(OutputError, match="that has changed since"):
        export_scans(str(scans), ours, "pcd")
    assert (ours / MANIFEST).is_file(), "of the scan that is there"


def test_range_images_of_one_sensor_are_not_taken_for_those_of_another(samples, tmp_path, capsys):
    np.save(tmp_path / "image.npy", np.full((16, 1800), 9, np.float32))
    vlp16 = load_sensor("vlp16")
    (tmp_path / "other.json").write_text(json.dumps({**vlp16.to_json(), "name": "other", "range_max_m": 50.0}))
    words = ["export", str(tmp_path / "image.npy"), str(tmp_path / "out"), "--sensor"]
    assert main([*words, "vlp16"]) == 0
    assert main([*words, "vlp16"]) == 0, "the same command"
    assert (tmp_path / "out" / "image.bin").is_file(), "an image keeps its name"
    assert main([*words, str(tmp_path / "other.json")]) == 2
    assert "export.json has another 'sensor'" in capsys.readouterr().err
    for source, kind in (("simulated:1", "scans"), (str(samples), "generated range images")):
        with pytest.raises(ConfigError, match=f"--sensor vlp16 for .*, which holds {kind}; .*; leave --sensor out"):
            export_scans(source, tmp_path / "none", "ply", sensor=vlp16)
    assert not (tmp_path / "none").exists()


def test_other_formats_and_sources_are_refused(samples, tmp_path):
    for kind in ("plx", "ouster_pcap", "pcap", "", "image"):
        with pytest.raises(UnknownNameError, match="the format") as refused:
            export_scans(str(samples), tmp_path / "out", kind)
        wanted = set(re.split(", | or ", refused.value.wanted))
        assert {"kitti_bin", "pcd", "ply", "las", "numpy_array", "kitti_odometry"} <= wanted
        assert not {"image", "ouster_pcap"} & wanted
    with pytest.raises(DataError):
        export_scans(str(tmp_path / "nowhere"), tmp_path / "out", "ply")
    with pytest.raises(ConfigError):
        export_scans(str(samples), tmp_path / "out", "ply", DataConfig(max_scans=-1))
    assert not (tmp_path / "out").exists()


def test_the_command(samples, tmp_path, capsys):
    words = ["export", str(samples), str(tmp_path / "out"), "--format", "pcd"]
    assert main(words) == 0
    assert re.match(r"done: 2 scans in .*out", capsys.readouterr().out)
    assert main([*words[:-1], "ply"]) == 2
    assert "wanted an empty folder" in capsys.readouterr().err


@pytest.mark.parametrize(("kind", "told"), [("bin", 1), ("npy", 1), ("npz", 0), ("kitti_odometry", 0)])
def test_labels_that_a_format_does_not_keep_are_told_once(streets, tmp_path, kind, told, heard):
    export_scans(streets, tmp_path, kind, DataConfig(max_scans=2))
    assert [text.partition(";")[0] for text in heard] == [f".{kind} keeps no labels"] * told


def poses_of(source):
    """Return names, times and poses of a source."""
    scans = open_dataset(source).timed_scans()
    poses = [scan.motion.pose.numpy() for scan in scans if scan.motion.pose is not None]
    return [scan.name for scan in scans], np.array([scan.motion.time_s for scan in scans]), np.array(poses)


@pytest.fixture
def wandering(tmp_path):
    """Return the folder of a drive of five scans numbered from 7, at times and places of a recording's own clock."""
    folder = tmp_path / "drive" / "clouds"
    folder.mkdir(parents=True)
    step = np.array([[0.96, -0.28, 0, 0.7], [0.28, 0.96, 0, 0.1], [0, 0, 1, 0.02], [0, 0, 0, 1]])
    pose = np.array([[0, -1.0, 0, 458_123.123456789], [1, 0, 0, 5_428_765.987654321], [0, 0, 1, 101.5], [0, 0, 0, 1]])
    poses = [pose := pose @ step for _ in range(5)]
    for number in range(7, 12):
        np.full((20, 4), number / 16, dtype="<f4").tofile(folder / f"{number:06d}.bin")
    rows = "".join(" ".join(map(repr, one[:3].ravel().tolist())) + "\n" for one in poses)
    (tmp_path / "drive" / "poses.txt").write_text(rows)
    (tmp_path / "drive" / "times.txt").write_text("".join(f"{1_538_444_123.4 + 0.1 * n:.7f}\n" for n in range(5)))
    return tmp_path / "drive"


def test_a_tree_keeps_the_times_and_poses_of_a_drive(wandering, tmp_path):
    _, times_s, poses = poses_of(str(wandering))
    assert (len(times_s), poses.shape) == (5, (5, 4, 4))
    assert export_scans(str(wandering), tmp_path / "tree", "kitti_odometry") == 5
    names, read_s, read = poses_of(f"kitti_odometry:{tmp_path / 'tree'}:00")
    assert names == [f"00/{number:06d}" for number in range(5)]
    assert np.abs(read_s - times_s).max() < 1e-6, "a double of seconds since 1970 has no more"
    assert np.array_equal(read, poses)
    # By hand: KITTI's rows are of a camera behind Tr, x to the right, y down, z ahead.
    lines = (tmp_path / "tree" / "sequences" / "00" / "calib.txt").read_text().splitlines()
    (tr,) = [np.array(line.split()[1:], float).reshape(3, 4) for line in lines if line.startswith("Tr:")]
    assert np.array_equal(tr[:, :3] @ [1, 0, 0], [0, 0, 1])
    rows = np.loadtxt(tmp_path / "tree" / "poses" / "00.txt").reshape(-1, 3, 4)
    assert np.allclose(rows[2][:, 3], tr[:, :3] @ poses[2][:3, 3])


def test_a_tree_of_some_scans_keeps_their_poses_and_a_later_one_of_all_adds_theirs(wandering, tmp_path):
    export_scans(str(wandering), tmp_path / "all", "kitti_odometry")
    source, some = f"kitti_odometry:{tmp_path / 'all'}:00", tmp_path / "some"
    _, times_s, poses = poses_of(source)
    export_scans(source, some, "kitti_odometry", DataConfig(max_scans=2))
    names, read_s, read = poses_of(f"kitti_odometry:{some}:00")
    assert names == ["00/000000", "00/000002"]
    assert np.array_equal(read, poses[[0, 2]])
    assert np.array_equal(read_s, times_s[[0, 2]])
    (some / "sequences" / "00" / "times.txt").unlink()  # all files that name a time are written anew
    for _ in range(2):  # of fewer again, nothing changes
        export_scans(source, some, "kitti_odometry")
        written = contents(some)
        export_scans(source, some, "kitti_odometry", DataConfig(max_scans=2))
        assert {**contents(some), MANIFEST: b""} == {**written, MANIFEST: b""}
    assert len((some / "sequences" / "00" / "poses.txt").read_text().splitlines()) == 5


def test_a_tree_is_written_without_times_that_do_not_rise_or_are_not_known_of_all(wandering, tmp_path, heard):
    (wandering / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    (wandering / "times.txt").write_text("1\n2\n")  # of scans 0 and 1, which are not there
    (wandering / "clouds" / "000007.bin").rename(wandering / "clouds" / "000000.bin")
    export_scans(str(wandering), tmp_path / "tree", "kitti_odometry")
    assert heard == ["some scans of sequence 00 have no time or pose, so none is written"]
    assert sorted(path.name for path in (tmp_path / "tree" / "sequences" / "00").iterdir()) == ["velodyne"]
    layout = KittiTree(tmp_path / "other")
    layout.write_motions(["sequences/00/velodyne/000000.bin", "sequences/00/velodyne/000001.bin"], [Motion(1.0)] * 2)
    assert heard[1:] == ["sequence 00 is written without times, which do not rise from scan to scan"]
    assert not (tmp_path / "other").exists()

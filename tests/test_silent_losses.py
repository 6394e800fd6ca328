"""Sources whose scans would be lost, mixed up or read wrongly without a word: refused in one line, or read whole."""

import json
import os
import re
import sqlite3
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidargrit.cli import main
from lidargrit.core.errors import ConfigError, DataError, OutputError, ScanError
from lidargrit.data.datasets import open_dataset
from lidargrit.data.drives import DriveConfig, write_drives
from lidargrit.data.formats import read_scan
from lidargrit.data.formats.kitti_bin import KittiBin
from lidargrit.data.formats.ouster_pcap import sensor_of
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.prepared.prepare import prepare, prepare_and_describe
from lidargrit.data.prepared.prepared import PreparedImages
from lidargrit.data.prepared.workers import make_some_shards
from lidargrit.data.sources import open_source
from lidargrit.data.sources.samples import read_samples
from lidargrit.scans.condition import Observed
from lidargrit.scans.fit_sensor import fit_sensor
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import Scan
from lidargrit.simulator import simulate
from lidargrit.systems.multiscale.system import Multiscale

K360, VLP16 = load_sensor("hdl64e_kitti_360"), load_sensor("vlp16")


@pytest.fixture
def kitti(tmp_path):
    """A folder of two scans."""
    folder = tmp_path / "scans"
    folder.mkdir()
    for seed in (0, 1):
        KittiBin.write(folder / f"{seed:06d}.bin", simulate(seed, K360.with_columns(128)))
    return folder


def xyz(count: int) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.stack((10 * np.cos(angle), 10 * np.sin(angle), np.linspace(-2, 1, count)), 1).astype(np.float32)


def test_a_reach_in_millimetres_is_refused():
    with pytest.raises(ConfigError, match="<= 1,000 m") as refusal:
        replace(K360, range_max_m=80_000.0)
    assert "divide them by 1000" in refusal.value.cure


def test_a_folder_that_cannot_be_read_is_not_left_out(kitti, monkeypatch):
    (kitti / "b").mkdir()
    listed = os.scandir

    def scandir(path):
        if str(path).endswith("/b"):
            raise PermissionError(13, "Permission denied", str(path))
        return listed(path)

    monkeypatch.setattr(os, "scandir", scandir)
    with pytest.raises(DataError, match="b, which cannot be read"):
        open_dataset(str(kitti))


def test_hidden_files_and_folders_are_no_scans(tmp_path):
    folder = tmp_path / "sequences" / "00" / "velodyne"
    folder.mkdir(parents=True)
    KittiBin.write(folder / "000000.bin", simulate(0, K360.with_columns(128)))
    (folder / "._000000.bin").write_bytes(bytes(16 * 256))
    (folder / "copies.bin").mkdir()
    assert len(open_dataset(f"kitti_odometry:{tmp_path}")) == 1


def test_a_name_with_a_colon_is_a_path_where_it_exists(kitti, monkeypatch):
    (kitti / "000000.bin").rename(kitti / "12:30:00.bin")
    monkeypatch.chdir(kitti)
    assert len(open_dataset("12:30:00.bin")) == 1


def test_a_recording_that_was_not_closed_is_refused(tmp_path):
    with sqlite3.connect(tmp_path / "drive.db3") as database:
        database.execute("CREATE TABLE topics (id INTEGER, name TEXT, type TEXT)")
    (tmp_path / "drive.db3-wal").write_bytes(b"pages")
    with pytest.raises(ScanError, match=r"last messages lie in drive\.db3-wal") as refusal:
        read_scan(tmp_path / "drive.db3")
    assert "wal_checkpoint" in refusal.value.cure


def test_two_scans_of_one_name_are_not_exported_over_each_other(tmp_path, capsys):
    folder = tmp_path / "samples" / "LIDAR_TOP"
    other = tmp_path / "sweeps" / "LIDAR_TOP"
    for each in (folder, other):
        each.mkdir(parents=True)
        rows = np.zeros((64, 5), np.float32)
        rows[:, :3] = xyz(64)
        rows[:, 4] = np.arange(64) % 32
        (each / "n008-2018-08-01-15-16-36-0400__LIDAR_TOP__1533151603547590.pcd.bin").write_bytes(rows.tobytes())
    source, out = str(tmp_path), str(tmp_path.with_name("out"))
    for words in (
        ["export", source, out, "--format", "ply"],
        ["complete", source, out, "--observed", "rows:4", "--model", "nearest", "--sensor", "hdl32e"],
        ["compress", source, f"{out}.lgz"],
    ):
        assert main(words) == 2
        assert "got several scans of " in capsys.readouterr().err
    assert list(tmp_path.parent.glob("out*")) == []


@pytest.mark.parametrize(("before", "separator"), [("# ", " "), ("#", ","), ("//", " ")])
def test_a_header_behind_a_comment_sign_names_the_columns(tmp_path, before, separator):
    path = tmp_path / "scan.csv"
    table = np.column_stack((xyz(64), np.full(64, 0.5), np.zeros(64)))
    header = separator.join(("x", "y", "z", "intensity", "x"))
    np.savetxt(path, table, "%.9g", separator, header=header, comments=before)
    scan = read_scan(path)
    np.testing.assert_array_equal(scan.points_xyz_m.numpy(), xyz(64))
    assert scan.reflectance is not None
    assert bool((scan.reflectance == 0.5).all())


def test_a_word_in_a_cell_is_refused(tmp_path):
    path = tmp_path / "scan.csv"
    path.write_text("x,y,z\n1,2,3\n1,a,3\n")
    with pytest.raises(ScanError, match="lines cannot be read") as refusal:
        read_scan(path)
    assert "decimal point" in refusal.value.cure


def test_the_mode_of_an_old_ouster_tells_its_columns(tmp_path):
    path = tmp_path / "drive.json"
    beams = {"beam_altitude_angles": [10.0, 0.0], "beam_azimuth_angles": [1.0, -1.0]}
    for mode, columns in (({"lidar_mode": "2048x10"}, 2048), ({}, 1024)):
        path.write_text(json.dumps(beams | mode))
        assert sensor_of(path).width == columns


@pytest.mark.parametrize("rings", ["from 1", "without the highest"])
def test_a_sensor_fitted_to_rings_with_a_gap_takes_the_scans_it_was_fitted_to(rings):
    scans = []
    for seed in range(3):
        scan = simulate(seed, load_sensor("vlp16").with_columns(450))
        assert scan.ring is not None
        if rings == "from 1":
            scans.append(replace(scan, ring=scan.ring + 1))
        else:
            kept = scan.ring > 0
            scans.append(Scan(scan.points_xyz_m[kept], None, scan.ring[kept]))
    assert fit_sensor(scans, "ours").sensor.projection == "spherical"


def test_a_ring_that_all_points_have_is_none(tmp_path):
    np.savetxt(tmp_path / "scan.csv", np.column_stack((xyz(400), np.zeros(400))), header="x y z ring", comments="")
    assert read_scan(tmp_path / "scan.csv").ring is None
    np.savetxt(tmp_path / "flat.csv", [(1, 2, 0, 0), (2, 1, 0, 0)], header="x y z ring", comments="")
    assert read_scan(tmp_path / "flat.csv").ring is not None


def test_reflectance_that_is_nan_is_named_and_can_be_dropped(tmp_path):
    reflectance = np.full(400, 0.5, np.float32)
    reflectance[7] = np.nan
    table = np.column_stack((xyz(400), reflectance))
    np.savetxt(tmp_path / "scan.csv", table, header="x y z intensity", comments="")
    with pytest.raises(ScanError, match="1 of 400 points with NaN for reflectance"):
        read_scan(tmp_path / "scan.csv")
    assert len(read_scan(tmp_path / "scan.csv", bad_points="drop")) == 399


def test_a_source_may_be_named_in_another_way_when_it_is_prepared_again(kitti, tmp_path):
    prepare(str(kitti), DataConfig(), tmp_path / "prepared")
    prepare(f"{kitti}/", DataConfig(), tmp_path / "prepared")
    KittiBin.write(kitti / "000002.bin", simulate(2, K360.with_columns(128)))
    with pytest.raises(OutputError, match="stale"):
        prepare(str(kitti), DataConfig(), tmp_path / "prepared")


def test_nothing_prepared_is_no_success(tmp_path, capsys):
    (tmp_path / "bad.bin").write_bytes(bytes(160))
    assert main(["prepare", str(tmp_path / "bad.bin"), "--bad-scans", "skip", "-o", str(tmp_path / "prepared")]) != 0
    assert "no usable scan" in capsys.readouterr().err


def test_a_process_whose_source_has_gone_says_so_in_one_line(kitti, tmp_path, capsys):
    prepared = prepare(str(kitti), DataConfig(), tmp_path / "prepared")
    kitti.rename(tmp_path / "elsewhere")
    assert make_some_shards(prepared, os.getppid(), [0]) == 2
    assert json.loads(capsys.readouterr().out)["error"][0] == "DataError"


def test_a_process_that_is_ended_while_nobody_listens_says_nothing():
    """What it was about to print would otherwise be told as an error when Python ends."""
    code = """
import runpy, sys
from lidargrit.data.prepared import workers
def interrupted(*_):
    print(1)
    raise KeyboardInterrupt
workers.make_some_shards = interrupted
sys.argv = ["", "folder", "1"]
runpy.run_module("lidargrit.data.prepared", run_name="__main__")
"""
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    command, pipe = [sys.executable, "-c", code], subprocess.PIPE
    process = subprocess.Popen(command, stdout=pipe, stderr=pipe, env=buffered)
    process.stdout.close()
    assert (process.stderr.read(), process.wait()) == (b"", 130)
    process.stderr.close()


def test_a_simulation_without_a_return_leaves_its_folder_free(tmp_path):
    up = replace(load_sensor("vlp16").with_columns(32), elevation_rad=torch.linspace(1.56, 1.54, 16)[:, None])
    with pytest.raises(DataError, match="no return in the simulated street"):
        write_drives(tmp_path / "drive", 1, DriveConfig(up))
    config = DriveConfig(load_sensor("vlp16").with_columns(32))
    assert write_drives(tmp_path / "drive", 2, config) == 2
    assert write_drives(tmp_path / "drive", 1, config) == 2


def test_names_of_files_do_not_reach_the_terminal_as_they_are(tmp_path, capsys):
    KittiBin.write(tmp_path / "e\x1b[31mRED.bin", simulate(0, K360.with_columns(128)))
    assert main(["inspect", str(tmp_path / "e\x1b[31mRED.bin")]) == 0
    assert "\x1b" not in capsys.readouterr().out


def test_a_condition_of_another_size_than_its_sensor_is_refused():
    known, range_m = torch.zeros(1, 64, 32, dtype=torch.bool), torch.zeros(1, 64, 32)
    with pytest.raises(ConfigError, match="range_m of"):
        Observed(range_m, known, known, known, K360.with_columns(64))


@pytest.mark.parametrize(("usual", "bright", "told"), [(1, 3, "by 1 in 5 scans"), (250, 300, "by 255 in 5 scans")])
def test_a_bright_point_that_makes_its_scan_darker_is_told(tmp_path, usual, bright, told, heard):
    scan = simulate(0, VLP16)
    for number in range(6):
        intensity = torch.linspace(0, usual, len(scan)).numpy().round()
        intensity[0] = bright if number == 5 else usual
        np.savez(tmp_path / f"{number}.npz", points=scan.points_xyz_m.numpy(), intensity=intensity)
    config = DataConfig(sensor="vlp16", columns=180, workers=1)
    folder = prepare_and_describe(str(tmp_path), open_dataset(str(tmp_path)), config, tmp_path / "out").folder
    for said in (heard, PreparedImages(str(folder)).remarks()):
        (warning,) = (line for line in said if "reflectance" in line)
        assert f"divided {told} and by" in warning
        assert "in 1 scan, such as" in warning
        assert f"{tmp_path.name}/5.npz" in warning
    source = open_source(str(folder))
    source.images()
    (doubt,) = source.doubts
    assert doubt in warning
    assert not PreparedImages(str(folder)).evenly_spaced(3).doubts(), "the first, the third and the fifth"


def test_dark_scans_of_whole_numbers_and_bytes_are_of_one_scale(tmp_path):
    points = simulate(0, VLP16).points_xyz_m.numpy()
    for name, values in (("zero", np.zeros(len(points), "u2")), ("byte", np.ones(len(points), "u1"))):
        np.savez(tmp_path / f"{name}.npz", points=points, intensity=values)
        assert read_scan(tmp_path / f"{name}.npz").full_scale == 0, name
    np.savez(tmp_path / "a.npz", points=points, intensity=np.full(len(points), 256, "u2"))
    assert read_scan(tmp_path / "a.npz").full_scale == 65_535


def by_turns(scan: Scan) -> torch.Tensor:
    """Return the points of 16 lasers as they are fired: the lowest, the ninth, the second, the tenth, ..."""
    order = torch.stack((torch.arange(15, 7, -1), torch.arange(7, -1, -1)), 1).flatten().argsort()
    azimuth_rad = torch.atan2(scan.points_xyz_m[:, 1], scan.points_xyz_m[:, 0])
    column = ((torch.pi - azimuth_rad) / (2 * torch.pi) * 1800).long()
    return scan.points_xyz_m[(column * 16 + order[scan.ring]).argsort()]


@pytest.mark.parametrize("fired", ["ring by ring", "by turns", "shuffled"])
def test_wide_rows_are_refused_and_bare_ones_are_not(tmp_path, fired):
    scan, rng = simulate(0, VLP16), np.random.default_rng(0)
    points = (by_turns(scan) if fired == "by turns" else scan.points_xyz_m).numpy()
    count = len(points) // 12 * 12  # whole rows of all widths
    ring, time = np.arange(count) % 16, np.linspace(0, 0.1, count)
    columns = [*points[:count].T, rng.random(count), ring, time, np.zeros(count), np.ones(count)]
    table = np.column_stack(columns).astype("<f4")
    table = rng.permutation(table) if fired == "shuffled" else table
    for width in range(3, 9):
        path = tmp_path / f"{width}.bin"
        path.write_bytes(np.ascontiguousarray(table[:, :width]).tobytes())
        if width <= 4:
            assert len(read_scan(path)) == count
            continue
        with pytest.raises(ScanError, match=f"rows of {width} numbers") as refusal:
            read_scan(path)
        assert ("name it .pcd.bin" in refusal.value.cure) == (width == 5)


@pytest.mark.parametrize("row", [b"4,5,6,2,99", b"4,5,6,2,,9"])
def test_lines_with_more_fields_than_names_are_refused(tmp_path, row):
    (tmp_path / "a.csv").write_bytes(b"x,y,z,ring\n1,2,3,1\n" + row + b"\n")
    with pytest.raises(ScanError, match=r"a line of [56] fields below 4 names") as refusal:
        read_scan(tmp_path / "a.csv")
    assert "name every column" in refusal.value.cure
    (tmp_path / "a.csv").write_bytes(b"x,y,z,ring\n1,2,3,1,\r\n4,5,6,2\r\n")
    assert len(read_scan(tmp_path / "a.csv")) == 2, "an empty field at the end names nothing"
    (tmp_path / "a.csv").write_bytes(b"x  y z\n1 2   3 \n4 5 6\n")
    assert len(read_scan(tmp_path / "a.csv")) == 2


@pytest.mark.parametrize("turned", [False, True])
def test_rings_counted_from_1_are_refused(tmp_path, turned):
    scan = simulate(0, VLP16)
    ring = scan.ring.numpy()
    ring = 15 - ring if turned else ring
    for count_from, rings in ((0, ring), (1, ring + 1)):
        np.savez(tmp_path / f"{count_from}.npz", points=scan.points_xyz_m.numpy(), ring=rings)
    assert torch.equal(read_scan(tmp_path / "0.npz").ring, scan.ring)
    with pytest.raises(ScanError, match=r"rings from \d+ to 16 in .*counted from 1; .*subtract 1"):
        read_scan(tmp_path / "1.npz")


def test_compress_says_once_what_it_does_not_keep(kitti, tmp_path, capsys):
    pytest.importorskip("constriction")
    torch.manual_seed(0)
    Multiscale(Multiscale.smallest_config(K360), K360.with_columns(32)).save(tmp_path / "run")
    words = ["compress", str(kitti), str(tmp_path / "scans.lgz"), "--model", str(tmp_path / "run")]
    assert main(words) == 0
    assert capsys.readouterr().err.count(".lgz keeps no reflectance\n") == 1


def test_a_sample_that_lacks_the_reflectance_of_those_beside_it_is_not_read_without_a_word(tmp_path):
    (tmp_path / "samples.json").write_text(json.dumps({"sensor": K360.with_columns(32).to_json()}))
    pixels = np.full((64, 32), 5, np.float32)
    for seed in range(3):
        more = {} if seed == 2 else {"reflectance": pixels / 10}
        np.savez(tmp_path / f"{seed:08d}.npz", range_m=pixels, **more)
    images = read_samples(tmp_path)
    assert images.batch([0, 1]).reflectance is not None
    with pytest.raises(DataError, match=r"sample 00000002 without reflectance; wanted what the first"):
        images.batch([1, 2])


@pytest.mark.parametrize("words", [("export", "--format", "npz"), ("rescan", "--to", "vlp16", "--format", "npz")])
def test_scans_that_have_changed_are_not_taken_for_those_that_were_written(kitti, tmp_path, capsys, words):
    command = [words[0], str(kitti), str(tmp_path / "out"), *words[1:]]
    assert main(command) == 0
    assert main(command) == 0, "the same command goes on"
    KittiBin.write(kitti / "000001.bin", simulate(7, K360.with_columns(128)))
    capsys.readouterr()
    assert main(command) == 2
    assert f"where 000001.npz is of a scan of {kitti} that has changed since" in capsys.readouterr().err
    (tmp_path / "out" / "000001.npz").unlink()
    assert main(command) == 0, "what is missing is made of the scan as it is now"
    assert main(command) == 0


@pytest.mark.parametrize(
    "words", [("inspect", "-o", "a.png"), ("view", "-o", "a.png"), ("inspect", "-o", "link.png", "--overwrite")]
)
def test_a_file_that_is_read_is_never_replaced(tmp_path, monkeypatch, capsys, words):
    monkeypatch.chdir(tmp_path)
    picture = tmp_path / "a.png"
    picture.write_bytes(b"somebody's")
    (tmp_path / "link.png").symlink_to(picture)
    assert main([words[0], "a.png", *words[1:]]) == 2
    assert "which is also read; wanted another name" in capsys.readouterr().err
    assert picture.read_bytes() == b"somebody's"


@pytest.mark.parametrize("kind", ["npy", "tensors"])
def test_images_that_have_changed_are_not_taken_for_those_that_were_written(tmp_path, capsys, kind):
    scans, out = tmp_path / "scans", tmp_path / "out"
    scans.mkdir()
    if kind == "npy":
        (scans / "sensor.json").write_text(json.dumps(K360.with_columns(128).to_json()))

    def save(range_m):
        if kind == "npy":
            np.save(scans / "one.npy", np.full((64, 128), range_m, np.float32))
        else:
            torch.save(torch.full((1, 64, 1024), range_m), scans / "one.pth")

    save(5.0)
    command = ["export", str(scans), str(out), "--format", "ply"]
    assert main(command) == 0
    assert main(command) == 0, "the same command goes on"
    save(6.0)
    capsys.readouterr()
    assert main(command) == 2
    assert f"of a scan of {scans} that has changed since" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["export", "--format", "npz"], ["view", "-n", "2"]])
def test_points_that_are_dropped_are_counted_once_for_all_scans(kitti, tmp_path, capsys, words):
    for number, path in enumerate(sorted(kitti.glob("*.bin")), start=1):
        points = np.fromfile(path, np.float32).reshape(-1, 4)
        points[:number] = np.nan
        points.tofile(path)
    out = ["-o", str(tmp_path / "view.png")] if words[0] == "view" else [str(tmp_path / "out")]
    assert main([words[0], str(kitti), *out, *words[1:], "--bad-points", "drop"]) == 0
    told = re.findall(r": [12] of [\d,]+ points left out: NaN, infinite or at the origin\n", capsys.readouterr().err)
    assert len(told) == 1

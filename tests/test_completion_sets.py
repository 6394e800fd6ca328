"""Whole sets of scans: what a completed scan may depend on, scans that cannot be used, and sensors of fewer columns."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidargrit.cli import main
from lidargrit.core.errors import OutputError
from lidargrit.core.files import write_json, write_text
from lidargrit.data.formats.numpy_array import NumpyArray
from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.pixel_decoder.phase_network import PixelDecoderConfig
from lidargrit.inference.complete.clouds_to_files import suffix_of
from lidargrit.inference.complete.inputs import ScanReader, open_inputs
from lidargrit.inference.complete.sparse import SparseReader
from lidargrit.scans.projection import unproject
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage, Scan
from lidargrit.systems.lidargrit.system import LidarGrit
from lidargrit.viewer.demo import divided

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(32)


def wall(sensor, seed: int, reflectance: bool = True) -> RangeImage:
    """Return a wall around the sensor with holes, no two alike."""
    rng = torch.Generator().manual_seed(seed)
    size = (sensor.height, sensor.width)
    range_m = 10 + 5 * torch.rand(size, generator=rng)
    returned = torch.rand(size, generator=rng) < 0.9
    planes = {"reflectance": torch.rand(size, generator=rng)} if reflectance else {}
    return RangeImage.masked(range_m, returned, sensor, planes)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "run"
    torch.manual_seed(0)
    pixels = PixelDecoderConfig(mask_features=2, range_features=2, mask_width=4, range_width=4, blocks=1)
    LidarGrit(replace(LidarGrit.smallest_config(SENSOR), pixels=pixels), SENSOR).eval().save(folder)
    return folder


def scan_files(folder, count: int, **settings):
    for number in range(count):
        NumpyArray.write(folder / f"{number}.npz", unproject(wall(SENSOR, number, **settings)))
    return str(folder)


def complete(run, source, out, *words) -> int:
    observed = () if "--observed" in words else ("--observed", "sector:90,270")
    model = () if "--model" in words else ("--model", str(run))
    return main(["complete", source, str(out), *observed, *model, "--device", "cpu", *words])


def test_more_scans_of_a_set_change_none(run, tmp_path):
    source = scan_files(tmp_path / "scans", 4)
    for words in (("-n", "2"), ()):
        assert complete(run, source, tmp_path / "grown", *words) == 0
    assert complete(run, source, tmp_path / "whole") == 0
    for number in range(4):
        grown, whole = (tmp_path / name / f"{number}.npz" for name in ("grown", "whole"))
        assert grown.read_bytes() == whole.read_bytes()


def test_images_of_a_set_keep_their_seeds_too(run, tmp_path):
    (tmp_path / "images").mkdir()
    for number in range(4):
        np.save(tmp_path / "images" / f"{number}.npy", wall(SENSOR, 0).range_m.numpy())
    words = ("--format", "image")
    assert complete(run, str(tmp_path / "images"), tmp_path / "some", "-n", "2", *words) == 0
    assert complete(run, str(tmp_path / "images"), tmp_path / "all", *words) == 0
    for path in (tmp_path / "some").glob("*.npy"):
        assert np.array_equal(np.load(path), np.load(tmp_path / "all" / path.name))
    first, second = (np.load(tmp_path / "all" / f"{number}.npy") for number in (0, 1))
    assert not np.array_equal(first, second)


@pytest.mark.parametrize("what", ["reflectance", "label"])
def test_a_scan_that_lacks_something_takes_it_from_no_other(tmp_path, what):
    folder = tmp_path / "scans"
    for number in range(3):
        scan = unproject(wall(SENSOR, number))
        scan = replace(scan, label=torch.full((len(scan),), 40))
        NumpyArray.write(folder / f"{number}.npz", replace(scan, **({what: None} if number == 1 else {})))
    assert complete(None, str(folder), tmp_path / "out", "--model", "nearest") == 0
    written = [getattr(NumpyArray.read(tmp_path / "out" / f"{number}.npz"), what) for number in range(3)]
    assert [each is None for each in written] == [False, True, False]


def test_a_scan_with_nothing_observed_is_left_out(run, tmp_path, capsys):
    source = scan_files(tmp_path / "scans", 2)
    behind = unproject(wall(SENSOR, 0))
    kept = behind.points_xyz_m[:, 0] < 0.5 * behind.points_xyz_m[:, 1].abs()
    NumpyArray.write(
        tmp_path / "scans" / "2.npz", Scan(behind.points_xyz_m[kept], behind.reflectance[kept], behind.ring[kept])
    )
    words = ("--observed", "sector:350,10", "--bad-scans", "skip")
    assert complete(run, source, tmp_path / "out", *words) == 0
    assert "left out: " in capsys.readouterr().err
    assert sorted(path.name for path in (tmp_path / "out").glob("*.npz")) == ["0.npz", "1.npz"]
    assert sorted(json.loads((tmp_path / "out" / "completed.json").read_text())["scans"]) == ["0.npz", "1.npz"]


def test_a_scan_without_a_drop_is_left_out(run, tmp_path, capsys):
    source, size = scan_files(tmp_path / "scans", 2), (SENSOR.height, SENSOR.width)
    whole = RangeImage.masked(
        torch.full(size, 9.0), torch.ones(size, dtype=torch.bool), SENSOR, {"reflectance": torch.rand(size)}
    )
    NumpyArray.write(tmp_path / "scans" / "00.npz", unproject(whole))
    assert complete(run, source, tmp_path / "out", "--observed", "returns", "--bad-scans", "skip") == 0
    assert "00.npz, in which every pixel has a return" in capsys.readouterr().err
    assert sorted(path.name for path in (tmp_path / "out").glob("*.npz")) == ["0.npz", "1.npz"]


def test_an_image_that_is_left_out_is_named(tmp_path, capsys):
    (tmp_path / "images").mkdir()
    for name, range_m in (("some", wall(SENSOR, 0).range_m), ("full", torch.full((SENSOR.height, SENSOR.width), 9.0))):
        np.save(tmp_path / "images" / f"{name}.npy", range_m.numpy())
    write_json(tmp_path / "sensor.json", SENSOR.to_json())
    words = ["nearest", "--sensor", str(tmp_path / "sensor.json")]
    source = str(tmp_path / "images")
    assert main(["complete", source, str(tmp_path / "out"), "--format", "image", "--model", *words]) == 2
    assert "full.npy, in which every pixel has a return" in capsys.readouterr().err
    np.save(
        tmp_path / "images" / "full.npy", np.pad(np.full((1, SENSOR.width), 9, "f4"), ((0, SENSOR.height - 1), (0, 0)))
    )
    hides = ["--protocol", "completion", "--observed", "rows:4", "--reference", source, *words[1:]]
    assert main(["compare", str(tmp_path / "table"), "nearest", *hides]) == 2
    assert "full.npy, of which --observed rows:4 observes no return" in capsys.readouterr().err


def test_a_scan_is_never_called_as_its_return_probabilities_are(run, tmp_path, capsys):
    source = scan_files(tmp_path / "scans", 1)
    (tmp_path / "scans" / "0.npz").rename(tmp_path / "scans" / "0.probability.npz")
    assert complete(run, source, tmp_path / "out", "--observed", "rows:4", "--format", "image") == 2
    assert "got a scan that would be 0.probability.npy" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_columns_in_which_a_sensor_never_fires_are_unknown():
    """All rays of the sensor return, so that no drop may be told of its scan."""
    source = load_sensor("vlp16").with_columns(100)
    wanted = load_sensor("hdl64e_kitti_odometry")  # 256 columns
    image = RangeImage.masked(
        torch.full((16, 100), 20.0), torch.ones(16, 100, dtype=torch.bool), source, {"reflectance": torch.rand(16, 100)}
    )
    scan = unproject(image)
    seen = SparseReader(wanted, source=source).read(scan)
    assert seen.on_grid is not None
    assert seen.point_of_pixel is not None
    assert bool(seen.image.return_mask[seen.on_grid].all())
    assert int(seen.on_grid.any(dim=0).sum()) == 100
    taken = seen.point_of_pixel[seen.on_grid]
    assert len(taken.unique()) == len(taken)
    apart = torch.atan2(*scan.points_xyz_m[taken].T[[1, 0]]) - wanted.azimuth_rad.expand(64, 256)[seen.on_grid]
    assert float(torch.atan2(apart.sin(), apart.cos()).abs().max()) <= np.pi / 256 + 1e-3
    assert seen.image.reflectance is not None
    assert torch.allclose(seen.image.reflectance[seen.on_grid], scan.reflectance[taken])


def test_a_sensor_that_fires_less_often_is_doubted():
    source = load_sensor("hdl64e_kitti_odometry").with_columns(870)
    scan = unproject(wall(source, 0))
    assert "have fewer columns" in ScanReader(load_sensor("hdl64e_kitti_odometry")).read(scan).doubt
    assert ScanReader(source).read(scan).doubt == ""


def two_walls(folder, sensor, columns):
    """Return two scans of so many columns as inputs for a sensor."""
    for name in ("0.npz", "1.npz"):
        NumpyArray.write(folder / name, unproject(wall(sensor.with_columns(columns), 0)))
    return open_inputs(str(folder), ScanReader(sensor), DataConfig())


def test_a_doubt_about_the_sensor_is_told_once(tmp_path, heard):
    inputs = two_walls(tmp_path, load_sensor("hdl64e_kitti_odometry"), 870)
    assert inputs.read(0).doubt
    assert inputs.read(1).doubt
    warnings = [line for line in heard if line.startswith("WARNING: ")]
    assert len(warnings) == 1
    assert "name the sensor that made the scan with --sensor, or take a model of it" in warnings[0]


def test_points_without_a_pixel_are_counted_once(tmp_path, heard):
    inputs = two_walls(tmp_path, load_sensor("hdl64e_kitti_odometry"), 1024)
    kept = [int(inputs.read(index).image.return_mask.sum()) for index in range(2)]
    points = len(inputs.read(0).points)
    counted = [line for line in heard if not line.startswith("WARNING: ")]
    assert [f"holds {kept[0]:,} of the {points:,} points" in line for line in counted] == [True]


def test_a_cloud_keeps_its_format_where_that_holds_all_of_its_points():
    kept = {ending: suffix_of(ending, "") for ending in (".bin", ".pcd.bin", ".ply", ".feather", ".png", ".pcap", "")}
    assert kept == {".bin": ".bin", ".pcd.bin": ".pcd.bin", ".ply": ".ply"} | dict.fromkeys(
        (".feather", ".png", ".pcap", ""), ".npz"
    )


def test_a_file_system_that_makes_no_folder_is_told_of(tmp_path, monkeypatch):
    def vanishing(folder):
        raise FileNotFoundError(2, "No such file or directory")

    monkeypatch.setattr("lidargrit.core.files._hidden", vanishing)
    with pytest.raises(OutputError, match="No such file"):
        write_text(tmp_path / "a.txt", "a")


def test_a_demo_holds_out_a_drive_of_a_seventh(tmp_path):
    for drive, count in (("00", 2), ("01", 9), ("02", 6)):
        for number in range(count):
            path = tmp_path / "sequences" / drive / "velodyne" / f"{number:06d}.bin"
            path.parent.mkdir(parents=True, exist_ok=True)
            np.ones((200, 4), "<f4").tofile(path)
    config = divided(f"kitti_odometry:{tmp_path}")
    assert config.train[0].endswith(":01+02")
    assert config.val[0].endswith(":00")

"""Scans that are completed, upsampled and dropped on the command line, by classical methods and by a small model."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lidargrit.cli import main
from lidargrit.core.errors import ConfigError, DataError, ScanError
from lidargrit.data import formats
from lidargrit.data.formats import read_scan
from lidargrit.data.formats.kitti_bin import KittiBin
from lidargrit.data.formats.numpy_array import NumpyArray
from lidargrit.data.formats.ply import Ply
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources import open_images, open_source
from lidargrit.evaluation.raydrop import RAYDROP_CURVES, decoded_surfaces, score_raydrop
from lidargrit.evaluation.realism import tables
from lidargrit.generation.generator import load, load_class
from lidargrit.generation.pixel_decoder.phase_network import PixelDecoderConfig
from lidargrit.inference.complete import open_model, open_models
from lidargrit.inference.complete.inputs import ScanReader, open_inputs
from lidargrit.inference.samples import write_samples
from lidargrit.scans.condition import Observed
from lidargrit.scans.fills import FILLS, fill
from lidargrit.scans.projection import unproject
from lidargrit.scans.sensors import SensorModel, load_sensor
from lidargrit.scans.types import RangeImage, Scan
from lidargrit.simulator import simulate
from lidargrit.systems.lidargrit.system import LidarGrit

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(32)
SIXTEEN = load_sensor("vlp16")


def street(sensor: SensorModel) -> RangeImage:
    """Return the ground, a wall around the sensor, and beams at the sky and at black spots that do not return."""
    elevation = sensor.elevation_rad.expand(sensor.height, sensor.width)
    wall_m = 12 + 4 * sensor.azimuth_rad.cos().expand_as(elevation)
    ground_m = torch.where(elevation < -0.02, 1.7 / -elevation.clamp(max=-0.02).sin(), 1e3)
    range_m = torch.minimum(wall_m / elevation.cos(), ground_m)
    spots = torch.rand(range_m.shape, generator=torch.Generator().manual_seed(0)) < 0.1
    return RangeImage.masked(range_m, (elevation < 0.03) & ~spots, sensor)


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Write two scans, their sensor, scans and samples of other sensors, and a small run with a pixel decoder."""
    root = tmp_path_factory.mktemp("completion")
    for name, sensor in (("scans", SENSOR), ("sparse", SIXTEEN)):
        for number in (1, 2):
            NumpyArray.write(root / name / "drive" / f"{number}.npz", unproject(street(sensor)))
    (root / "sensor.json").write_text(json.dumps(SENSOR.to_json()))
    torch.manual_seed(0)
    pixels = PixelDecoderConfig(mask_features=2, range_features=2, mask_width=4, range_width=4, blocks=1)
    model = LidarGrit(replace(LidarGrit.smallest_config(SENSOR), pixels=pixels), SENSOR).eval()
    model.save(root / "run")
    wide = LidarGrit(LidarGrit.smallest_config(SENSOR), SENSOR.with_columns(64)).eval()
    wide.save(root / "wide_run")
    write_samples(wide, root / "wide_run", root / "wide_samples", range(1))
    return root


def points_of(path, form=NumpyArray):
    return {tuple(point) for point in form.read(path).points_xyz_m.tolist()}


@pytest.mark.parametrize("method", FILLS)
def test_a_plane_and_a_wall_are_filled_in(method):
    image = RangeImage.stack([street(SENSOR)])
    observed = torch.zeros_like(image.return_mask)
    observed[:, 1::2] = True
    done = fill(method, Observed.of_pixels(image, observed))
    assert torch.equal(done.range_m[observed], image.range_m[observed])
    both = ~observed & image.return_mask & done.return_mask
    assert float(both.float().sum() / (~observed & image.return_mask).float().sum()) > 0.7
    error = (done.range_m - image.range_m)[both].abs().mean()
    assert float(error) < {"nearest": 0.6, "linear": 0.15, "triangulation": 0.15}[method]


def test_triangles_close_the_circle_and_are_exact_on_a_wall_where_rows_lack():
    inverse = 0.1 + 0.02 * SENSOR.elevation_rad.double().expand(64, 32)
    image = RangeImage.stack([RangeImage((1 / inverse).float(), torch.ones(64, 32, dtype=torch.bool), SENSOR)])
    observed = torch.ones(1, 64, 32, dtype=torch.bool)
    observed[:, 8:50, :3], observed[:, 8:50, -3:] = False, False  # around the seam
    done = fill("triangulation", Observed.of_pixels(image, observed))
    assert torch.allclose(done.range_m, image.range_m, rtol=1e-5)


def test_an_edge_is_not_smeared():
    range_m = torch.full((64, 32), 5.0)
    range_m[:, 16:] = 40.0
    image = RangeImage.stack([RangeImage(range_m, range_m > 0, SENSOR)])
    observed = torch.zeros(1, 64, 32, dtype=torch.bool)
    observed[:, :, ::3] = True
    for method in FILLS:
        assert set(fill(method, Observed.of_pixels(image, observed)).range_m.unique().tolist()) == {5.0, 40.0}


def test_samples_that_were_added_are_not_taken_for_those_completed_before(folders, tmp_path, capsys):
    model, samples = load(folders / "wide_run"), tmp_path / "samples"
    words = ["complete", str(samples), str(tmp_path / "out"), "--observed", "rows:4", "--format", "image"]
    words += ["--model", f"{folders}/wide_run"]
    write_samples(model, folders / "wide_run", samples, [10, 11])
    assert main(words) == 0
    assert open_source(words[2]).sensor.same_rays(model.sensor)
    write_samples(model, folders / "wide_run", samples, [4])
    assert main(words) == 2
    assert "000000.npy is another scan of" in capsys.readouterr().err


def test_complete_keeps_names_and_observed_points_and_goes_on(folders, tmp_path, capsys):
    words = ["complete", f"{folders}/scans", str(tmp_path / "out"), "--observed", "rows:4"]
    words += ["--model", "triangulation", "--sensor", f"{folders}/sensor.json"]
    assert main(words) == 0
    assert "done: 2 scans" in capsys.readouterr().out
    for number in (1, 2):
        scan = NumpyArray.read(folders / "scans/drive" / f"{number}.npz")
        done = NumpyArray.read(tmp_path / "out/drive" / f"{number}.npz")
        kept = scan.ring % 4 == 2
        own = {tuple(point) for point in scan.points_xyz_m[kept].tolist()}
        assert own <= points_of(tmp_path / f"out/drive/{number}.npz")
        assert len(done) > 3 * int(kept.sum())
    (tmp_path / "out/drive/2.npz").unlink()
    before = (tmp_path / "out/drive/1.npz").stat().st_mtime_ns
    assert main(words) == 0
    assert (tmp_path / "out/drive/1.npz").stat().st_mtime_ns == before
    assert (tmp_path / "out/drive/2.npz").exists()
    assert main([*words[:-3], "linear", *words[-2:]]) == 2
    assert "completed.json has another 'model'" in capsys.readouterr().err
    assert main([*words, "--projection", "spherical"]) == 2, "two projections in one folder"
    assert "completed.json has another 'projection'" in capsys.readouterr().err


def test_a_model_completes_in_several_ways_and_into_any_format(folders, tmp_path):
    out = tmp_path / "out"
    words = ["complete", f"{folders}/scans", str(out), "--model", f"{folders}/run", "--observed", "sector:90,270"]
    assert main([*words, "--samples", "2", "--format", "ply", "--device", "cpu"]) == 0
    ways = [points_of(out / f"completion_{way}/drive/1.ply", Ply) for way in (0, 1)]
    own = points_of(folders / "scans/drive/1.npz")
    behind = {point for point in own if point[0] < -0.5}
    assert all(behind <= way for way in ways)
    assert ways[0] != ways[1]
    assert points_of(out / "completion_0/drive/2.ply", Ply) != ways[0]  # another scan has another seed


def test_raydrop_drops_points_of_clean_scans_and_tells_how_often(folders, tmp_path):
    clean = street(SENSOR).range_m.numpy()
    np.save(tmp_path / "clean.npy", np.where(clean > 0, clean, np.inf))
    words = ["raydrop", str(tmp_path / "clean.npy"), str(tmp_path / "out"), "--model", f"{folders}/run"]
    assert main([*words, "--format", "image", "--probability", "9"]) == 0
    dropped, share = np.load(tmp_path / "out/clean.npy"), np.load(tmp_path / "out/clean.probability.npy")
    assert set(np.unique(share * 9).round(4)) <= set(range(10))
    assert not share[clean == 0].any()
    assert 0.05 < share[clean > 0].mean() < 0.95
    assert 0 < (dropped > 0).sum() < (clean > 0).sum()
    assert np.array_equal(dropped[dropped > 0], clean[dropped > 0])
    assert main([*words, "--format", "image", "--probability", "3"]) == 2  # whose shares would not be written
    assert main([*words, "--format", "image"]) == 2  # which would leave later scans without
    assert main(["raydrop", f"{folders}/scans", str(tmp_path / "points"), "--model", f"{folders}/run"]) == 0
    assert points_of(tmp_path / "points/drive/1.npz") < points_of(folders / "scans/drive/1.npz")


def test_an_image_whose_name_is_no_text_is_refused(tmp_path):
    with Path(os.fsdecode(os.fsencode(tmp_path) + b"/\xff.npy")).open("wb") as file:
        np.save(file, np.full((64, 32), 9, np.float32))
    with pytest.raises(DataError, match="which is not UTF-8"):
        open_inputs(str(tmp_path), ScanReader(SENSOR), DataConfig())


def test_two_images_whose_names_differ_in_letters_alone_are_two_files(tmp_path, recwarn):
    folder = tmp_path / "images"
    folder.mkdir()
    for name, factor in (("scan.npy", 1), ("scan.NPY", 0.5), ("huge.npy", 1e300)):  # the last is left out
        with (folder / name).open("wb") as file:
            np.save(file, street(SENSOR).range_m.double().numpy() * factor)
    words = ["complete", str(folder), str(tmp_path / "out"), "--model", "nearest", "--observed", "rows:4"]
    (tmp_path / "sensor.json").write_text(json.dumps(SENSOR.to_json()))
    assert main([*words, "--sensor", f"{tmp_path}/sensor.json", "--bad-scans", "skip"]) == 0
    scans = json.loads((tmp_path / "out/completed.json").read_text())["scans"]
    assert {file: Path(path).name for file, path in scans.items()} == {
        "scan.NPY.npz": "scan.NPY",
        "scan.npz": "scan.npy",
    }
    assert not recwarn.list


def test_completions_of_no_scan_leave_the_folder_to_a_corrected_command(folders, tmp_path, capsys):
    (tmp_path / "scans").mkdir()
    (tmp_path / "scans/1.bin").write_bytes(b"no scan at all, of an odd length")
    words = ["complete", str(tmp_path / "scans"), str(tmp_path / "out"), "--bad-scans", "skip", "--model"]
    assert main([*words, "linear"]) == 2
    assert "no usable scan" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    (tmp_path / "scans/1.bin").unlink()
    NumpyArray.write(tmp_path / "scans/1.npz", unproject(street(SENSOR)))
    assert main([*words, f"{folders}/run"]) == 0


def test_every_fourth_ring_in_firing_order_is_told_of_upsample(tmp_path, capsys):
    whole = simulate(0, load_sensor("hdl64e_kitti_odometry"))
    azimuth_rad = torch.atan2(whole.points_xyz_m[:, 1], whole.points_xyz_m[:, 0]) % (2 * torch.pi)
    fired = torch.argsort(whole.ring * 10 + azimuth_rad)
    fired = fired[whole.ring[fired] % 4 == 0]
    KittiBin.write(tmp_path / "scans" / "0.bin", Scan(whole.points_xyz_m[fired], whole.reflectance[fired]))
    words = ["complete", str(tmp_path / "scans"), str(tmp_path / "out"), "--model", "linear", "--observed", "rows:4"]
    assert main([*words, "--sensor", "hdl64e_kitti_odometry"]) == 2
    told = capsys.readouterr().err
    assert "got 16 rings in" in told
    assert "add the missing rows with: lidargrit upsample" in told


def test_upsample_adds_the_rows_that_lack(folders, tmp_path):
    words = ["upsample", f"{folders}/sparse", str(tmp_path / "out"), "--sensor", "vlp16"]
    assert main([*words, "--to", f"{folders}/sensor.json", "--model", "triangulation"]) == 0
    done = NumpyArray.read(tmp_path / "out/drive/1.npz")
    own = points_of(folders / "sparse/drive/1.npz")
    assert own <= points_of(tmp_path / "out/drive/1.npz")
    x, y, z = done.points_xyz_m[done.filled].T
    elevation_deg = torch.atan2(z, torch.hypot(x, y)).rad2deg()
    assert len((elevation_deg * 10).round().unique()) > 40
    between = (elevation_deg > -14) & (elevation_deg < -8.5)  # its rows that see the ground
    assert float((z[between] + 1.7).abs().median()) < 0.2


def test_scans_of_another_sensor_are_told_once(tmp_path, capsys):
    for seed in (0, 1):
        NumpyArray.write(tmp_path / "scans" / f"{seed}.npz", simulate(seed=seed))
    words = ["complete", str(tmp_path / "scans"), str(tmp_path / "out"), "--model", "nearest", "--observed", "rows:2"]
    assert main([*words, "--sensor", "vlp16"]) == 0
    told = capsys.readouterr().err
    assert told.count("WARNING: ") == 1
    assert "imaged as vlp16: " in told
    assert "the sensor that made the scans has more of them" in told


def test_a_file_that_was_cut_off_is_refused_and_bare_coordinates_stay_bare(tmp_path):
    sensor = load_sensor("hdl64e_kitti_odometry")
    scan = simulate(seed=3)
    rows = torch.cat([scan.points_xyz_m, scan.reflectance[:, None]], 1).numpy()
    (tmp_path / "cut.bin").write_bytes(rows[scan.ring.numpy() < 40].tobytes())
    with pytest.raises(ScanError, match="40 rings"):
        ScanReader(sensor).read(read_scan(tmp_path / "cut.bin"))
    shuffled = Scan(scan.points_xyz_m[torch.randperm(len(scan), generator=torch.Generator().manual_seed(0))])
    assert ScanReader(sensor).read(shuffled).image.return_mask.float().mean() > 0.5  # by elevation
    kept = scan.ring < 40
    told = Scan(scan.points_xyz_m[kept], ring=scan.ring[kept])  # a crop, or a sensor of forty lasers
    assert ScanReader(sensor).read(told).image.return_mask.any()
    (tmp_path / "bare").mkdir()
    (tmp_path / "bare" / "0.bin").write_bytes(np.ascontiguousarray(rows[:, :3]).tobytes())
    words = ["complete", str(tmp_path / "bare"), str(tmp_path / "out"), "--model", "linear", "--observed", "rows:2"]
    assert main(words) == 0
    (written,) = (tmp_path / "out").glob("*.bin")
    assert formats.recognise(written).public_name() == "xyz_bin"


def test_models_and_settings_are_compared_on_hidden_parts(folders, tmp_path, capsys):
    table = tmp_path / "table.json"
    models = [f"{folders}/run", f"{folders}/run:mask=threshold", "nearest", "triangulation"]

    def compared(folder, models, *more):
        words = ["compare", str(tmp_path / folder), *models, "--protocol", "completion"]
        return main([*words, "--reference", f"{folders}/scans", *more])

    assert compared("out", models, "--observed", "rows:4", "pixels:0.3", "--json", str(table)) == 0
    assert (tmp_path / "out" / "completion.json").read_bytes() == table.read_bytes()
    output = capsys.readouterr().out
    scores = json.loads(table.read_text())["scores"]
    assert [score["observed"] for score in scores] == ["rows:4"] * 4 + ["pixels:0.3"] * 4
    run, plain, nearest, triangles = scores[:4]
    assert output.count(plain["model"]) == 2
    assert (run["mae_m"], run["iou"]) != (plain["mae_m"], plain["iou"])
    assert triangles["mae_m"]["value"] < nearest["mae_m"]["value"] < run["mae_m"]["value"]
    assert run["diversity_m"]["value"] > 0.1
    difference = nearest["mae_m"]["value"] - triangles["mae_m"]["value"]
    assert nearest["beside_triangulation_m"]["value"] == pytest.approx(difference)
    assert compared("out", ["nearest"]) == 2
    assert "completion.json, which is there already" in capsys.readouterr().err
    assert compared("other", ["nearest"], "--flops", "1e9") == 2
    assert "got --flops with --protocol completion" in capsys.readouterr().err
    assert compared("other", ["nearest"], "--observed", "returns", "--sensor", f"{folders}/sensor.json") == 2
    assert "got --observed returns, which hides no return of these scans" in capsys.readouterr().err
    assert compared("other", [f"{folders}/run:mask=guess"]) == 2
    assert "mask=guess" in capsys.readouterr().err


def test_a_scan_of_which_nothing_is_observed_is_skipped_by_a_comparison(folders, tmp_path, capsys):
    for name in ("a", "b", "c"):
        image = street(SENSOR)
        kept = image.return_mask & ((SENSOR.azimuth_rad.abs() > 0.3) if name == "a" else True)
        NumpyArray.write(tmp_path / "in" / f"{name}.npz", unproject(RangeImage.masked(image.range_m, kept, SENSOR)))
    words = ["compare", f"{tmp_path}/out", "nearest", "--protocol", "completion", "--reference", f"{tmp_path}/in"]
    words += ["--sensor", f"{folders}/sensor.json", "--observed", "sector:-10,10", "rows:2"]
    assert main(words) == 2
    assert "of which --observed sector:-10,10 observes no return" in capsys.readouterr().err
    assert main([*words, "--bad-scans", "skip"]) == 0
    assert "left out: got " in capsys.readouterr().err
    scores = json.loads((tmp_path / "out/completion.json").read_text())["scores"]
    assert [score["num_scans"] for score in scores] == [2, 3]


def test_the_drops_of_a_model_are_scored_beside_independent_ones(folders):
    model, true = load(folders / "run"), RangeImage.stack([street(SENSOR)] * 4)
    every = torch.ones_like(true.return_mask)
    clean = RangeImage.masked(torch.where(true.return_mask, true.range_m, 30.0), every, SENSOR)
    scores = score_raydrop(model, "simulated", clean, true)
    assert [score.own.metric for score in scores] == list(RAYDROP_CURVES)
    assert all(score.real_against_real.value < 1e-3 < min(score.own.value, score.bernoulli.value) for score in scores)
    assert [row[0] for row in tables(scores)[0].rows] == ["scans compared", *RAYDROP_CURVES]
    scans = open_images(f"{folders}/scans", SENSOR)
    measured = scans.batch(range(len(scans)))
    decoded = decoded_surfaces(model, measured)
    returns = measured.return_mask.any(0)
    assert bool(returns.any())
    assert all(torch.equal(mask, returns) for mask in decoded.return_mask)
    with pytest.raises(ConfigError, match="which drops no returns of clean scans"):
        score_raydrop(
            load_class("marginal")(load_class("marginal").smallest_config(SENSOR), SENSOR), "real", clean, true
        )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["complete", "{}/sparse", "--model", "{}/run"], "16 rings in .*; wanted the 64 of the sensor"),
        (["complete", "{}/scans", "--model", "{}/run", "--observed", "{}/small.npy"], "a mask of 3x4 bool"),
        (["complete", "{}/scans", "--model", "{}/run", "--observed", "{}/all.npy"], "by which all pixels are observed"),
        (["complete", "{}/scans", "--model", "{}/run", "--observed", "{}/none.npy"], "none.npy observes no return"),
        (["complete", "{}/empty.npz", "--model", "{}/run"], "an empty file"),
        (["complete", "", "--model", "{}/run"], "got scans ''"),
        (["complete", "{}/wide.npy", "--model", "{}/run"], "a range image of 64x33; wanted 64x32"),
        (["complete", "{}/wide_samples", "--model", "{}/run"], "range images of 64x64 of the sensor"),
        (["complete", "{}/scans", "--model", "nothing"], "nothing, which does not exist"),
        (["complete", "{}/scans", "--model", "trianglation"], "wanted a run's folder, or triangulation; check"),
        (["complete", "{}/scans", "--model", "linear", "--samples", "2"], "--samples 2 for linear; wanted 1"),
        (["complete", "{}/scans", "--model", "{}/run", "--samples", "0"], "--samples 0; wanted a whole number from 1 "),
        (["raydrop", "{}/scans", "--model", "{}/run", "--probability", "-1"], "--probability -1; wanted a whole"),
        (
            ["complete", "{}/scans", "--model", "{}/run", "--samples", "9999999"],
            "9,999,999 completions of each of 2 scans",
        ),
        (["complete", "{}/scans", "--model", "{}/run", "--format", "las2"], "the format 'las2' to write"),
        (["complete", "{}/scans", "--model", "{}/run", "--format", "docx"], "wanted image, kitti_odometry, "),
        (
            ["raydrop", "{}/scans", "--model", "linear"],
            "--model linear, a classical method, which takes pixels of which range and return are known; wanted a run",
        ),
        (
            ["complete", "{}/scans", "--model", "linear", "--set", "sampling.a=1"],
            "--model linear for --set a=1; wanted a run",
        ),
        (
            ["upsample", "{}/sparse", "--model", "linear", "--sensor", "vlp16", "--to", "os1_64", "--samples", "3"],
            "--samples 3 for linear; wanted 1",
        ),
        (["upsample", "{}/sparse", "--model", "linear", "--sensor", "vlp16"], "name it with --to"),
        (["upsample", "{}/scans", "--model", "{}/run", "--sensor", "hdl64e_kitti_odometry"], "with 64 rows from"),
        (["upsample", "{}/flat.npy", "--model", "{}/run", "--sensor", "vlp16"], "a range image, which has no rows"),
        (
            ["upsample", "{}/scans", "--model", "linear", "--sensor", "vlp16", "--to", "{}/row.json"],
            "all of the 1 ",
        ),
        (
            ["upsample", "{}/sparse", "--model", "{}/run", "--sensor", "vlp16", "--to", "os1_64"],
            "the sensor 'os1_64', 64x1024, for",
        ),
    ],
)
def test_mistakes_are_told_in_one_line_and_nothing_is_written(words, message, folders, tmp_path, capsys, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    np.save(tmp_path / "here" / "whole.npy", np.full((64, 32), 9, np.float32))
    np.save(folders / "small.npy", np.ones((3, 4), bool))
    np.save(folders / "all.npy", np.ones((64, 32), bool))
    np.save(folders / "none.npy", np.zeros((64, 32), bool))
    np.save(folders / "wide.npy", np.ones((64, 33), np.float32))
    np.save(folders / "flat.npy", np.full((64, 32), 9, np.float32))
    one_row = replace(SENSOR, elevation_rad=torch.zeros(1, 1))
    (folders / "row.json").write_text(json.dumps(one_row.to_json()))
    (folders / "empty.npz").write_bytes(b"")
    words = [word.replace("{}", str(folders)) for word in words]
    assert main([*words[:2], str(tmp_path / "out"), *words[2:]]) == 2
    told = capsys.readouterr().err.splitlines()
    (error,) = [line for line in told if "no sensor is named" not in line]
    assert message.split("; ")[0].replace(".*", "").split(" in ")[0] in error
    assert not (tmp_path / "out").exists()


def test_a_device_that_is_none_is_refused_for_methods_that_compute_on_none():
    assert open_models(["nearest"], SENSOR)[0].sensor is SENSOR
    for open_them in (
        lambda: open_models(["nearest"], SENSOR, "nope"),
        lambda: open_model("linear", "pixels", SENSOR, device="nope"),
    ):
        with pytest.raises(ConfigError, match="got device 'nope'"):
            open_them()

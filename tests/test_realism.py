"""Simulated scans against real ones and independent drops: the comparison, its table, its picture and its verb."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from matplotlib.axes import Axes

from lidargrit.cli import main
from lidargrit.core.errors import ConfigError, DataError
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources import load_range_images
from lidargrit.evaluation import realism
from lidargrit.evaluation.metrics import load_metric
from lidargrit.evaluation.realism import CURVES, SimulatedScans, compare, drop_independently, simulate_pair, tables
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.systems.lidargrit.system import LidarGrit
from lidargrit.systems.raydrop.system import Raydrop
from lidargrit.viewer.curves import plot_curves

SENSOR = load_sensor("hdl64e_kitti_odometry")
COUNT = 3


@pytest.fixture(scope="module")
def simulated():
    pairs = [simulate_pair(seed, SENSOR) for seed in range(COUNT)]
    return SimulatedScans(*(RangeImage.stack(list(side)) for side in zip(*pairs, strict=True)))


@pytest.fixture(scope="module")
def recorded():
    """The same scans, as a data set: what compares as real here."""
    return load_range_images((f"simulated:{COUNT}",), DataConfig())


@pytest.fixture(scope="module")
def scores(simulated, recorded):
    return compare(simulated, recorded)


def test_what_is_measured_is_part_of_what_is_clean(simulated):
    clean, measured = simulated.clean, simulated.measured
    assert not (measured.return_mask & ~clean.return_mask).any()
    assert torch.equal(measured.range_m[measured.return_mask], clean.range_m[measured.return_mask])
    assert 0.7 < measured.return_mask.float().mean() < clean.return_mask.float().mean() < 1


def test_other_columns_than_are_fired_get_the_nearest_of_several_points_as_real_scans_do():
    rays = SENSOR.with_columns(256)
    real = load_range_images((f"simulated:{COUNT}",), DataConfig(columns=256)).batch(range(COUNT))
    images = [simulate_pair(seed, rays, SENSOR)[1] for seed in range(COUNT)]
    agree = [
        float((image.return_mask == mask).float().mean()) for image, mask in zip(images, real.return_mask, strict=True)
    ]
    single = simulate_pair(0, rays)[1].return_mask == real.return_mask[0]  # one ray for each pixel
    assert min(agree) > 0.98
    assert float(single.float().mean()) < 0.975


def test_independent_drops_keep_a_share_whatever_it_meets(simulated):
    for share in (0.3, 0.8):
        dropped = drop_independently(simulated.clean, share)
        assert math.isclose(dropped.return_mask.float().mean(), share, abs_tol=0.01)
        near = simulated.clean.return_mask & (simulated.clean.range_m < 8)
        far = simulated.clean.return_mask & (simulated.clean.range_m > 20)
        kept = [float(dropped.return_mask[some].float().mean()) for some in (near, far)]
        assert math.isclose(*kept, abs_tol=0.02)
        assert (dropped.reflectance[~dropped.return_mask] == 0).all()
        assert torch.equal(dropped.label, simulated.clean.label * dropped.return_mask)
    assert torch.equal(drop_independently(simulated.clean, 1.0).return_mask, simulated.clean.return_mask)
    assert torch.equal(dropped.return_mask, drop_independently(simulated.clean, 0.8).return_mask)


def test_scans_are_nearer_to_the_simulator_that_made_them_than_to_independent_drops(simulated, recorded, scores):
    """The two differ only by the projection and by the halves of the scans that real against real compares."""
    assert recorded.batch([0]).return_mask.sum() > 0
    named = {score.own.metric: score for score in scores}
    assert set(CURVES) - {"reflectance_histogram"} <= set(named) <= set(CURVES)
    for score in scores:
        assert score.own.value < (0.04 if score.own.metric == "wall_straightness" else 0.02)  # of few patches
        assert score.own.value < score.bernoulli.value
        assert score.real_against_real.value > score.own.value
        assert score.ratio == score.own.value / score.bernoulli.value
        assert (
            score.own.num_generated,
            score.real_against_real.num_generated,
            score.real_against_real.num_reference,
        ) == (3, 1, 2)


def test_distances_are_those_of_the_metrics(simulated, recorded, scores):
    real = recorded.batch(range(COUNT))
    independent = drop_independently(simulated.clean, float(real.return_mask.float().mean()))
    metric = load_metric("drop_run_lengths")()
    metric.update(independent, real=False)
    metric.update(real, real=True)
    score = next(score for score in scores if score.own.metric == "drop_run_lengths")
    assert np.isclose(score.bernoulli.value, metric.compute().value)


def test_the_table_names_every_curve(scores):
    lines = tables(scores)[0].as_text().splitlines()
    assert lines[1].split()[:2] == ["scans", "compared"]
    assert lines[1].count(" v ") == 2
    assert [line.split()[0] for line in lines[2:]] == [score.own.metric for score in scores]


def test_one_scan_and_other_rays_are_refused(simulated, recorded):
    with pytest.raises(DataError, match="got 1 real scan; wanted at least 2"):
        compare(simulated, load_range_images(("simulated:1",), DataConfig()))
    clean = simulated.clean
    elsewhere = SENSOR.with_columns(2048, 8)
    turned = RangeImage(clean.range_m, clean.return_mask, elsewhere.with_columns(256))
    with pytest.raises(ConfigError, match="simulate the sensor of the scans"):
        compare(SimulatedScans(turned, turned), recorded)


def test_the_picture_has_every_panel(scores, tmp_path):
    plot_curves(scores, tmp_path / "all.png", "title")
    plot_curves(scores[:1], tmp_path / "one.png")
    sizes = [(tmp_path / name).read_bytes()[16:24] for name in ("all.png", "one.png")]
    widths, heights = zip(*((int.from_bytes(s[:4]), int.from_bytes(s[4:])) for s in sizes), strict=True)
    assert widths == (1400, 1400)
    assert heights[0] > heights[1] > 300
    with pytest.raises(ConfigError, match=r"^got no curve; wanted at least one"):
        plot_curves([], tmp_path / "none.png")


def test_ranges_at_which_no_row_has_a_value_are_gaps_in_a_picture(scores, tmp_path):
    deep = next(score for score in scores if np.ndim(score.own.details.get("real")) == 2)
    nowhere = np.full_like(np.array(deep.own.details["generated"], dtype=float), np.nan)
    own = replace(deep.own, details={**deep.own.details, "generated": nowhere})
    plot_curves([replace(deep, own=own)], tmp_path / "gaps.png")
    assert (tmp_path / "gaps.png").stat().st_size > 1000


def test_scans_without_any_drop_have_a_picture(scores, tmp_path):
    runs = next(score for score in scores if score.own.details.get("axis_label", "").endswith("[pixels]"))
    none = np.zeros_like(np.array(runs.own.details["real"], dtype=float))
    result = replace(runs.own, details={**runs.own.details, "real": none, "generated": none})
    plot_curves([replace(runs, own=result, bernoulli=result)], tmp_path / "none.png")
    assert (tmp_path / "none.png").stat().st_size > 1000


def test_only_views_from_above_are_plotted_as_maps(tmp_path, monkeypatch):
    """The histograms of a sensor of 32 rows are 32x32, too."""
    sensor = load_sensor("hdl32e")
    simulated = SimulatedScans(*(RangeImage.stack([side, side]) for side in simulate_pair(0, sensor)))
    labels = []
    monkeypatch.setattr(Axes, "imshow", lambda *args, **settings: labels.append(settings["extent"]))
    scores = compare(
        simulated, load_range_images((f"simulated:2@{sensor.name}",), DataConfig(sensor=sensor.name)), CURVES
    )
    plot_curves([score for score in scores if score.own.metric != "bev_occupancy"], tmp_path / "none.png")
    assert not labels
    plot_curves([score for score in scores if score.own.metric == "bev_occupancy"], tmp_path / "maps.png")
    assert len(labels) == 3


def _distance(name, *sources):
    metric = load_metric(name)()
    for source, real in zip(sources, (False, True), strict=True):
        metric.update(load_range_images((source,), DataConfig()).batch([0, 1]), real=real)
    return metric.compute().value


def test_the_verb(tmp_path, capsys, monkeypatch):
    picture, file = tmp_path / "curves.png", tmp_path / "curves.json"
    torch.manual_seed(0)
    LidarGrit(LidarGrit.smallest_config(SENSOR), SENSOR).save(tmp_path / "run")
    words = ["evaluate", "simulated:2", "simulated:2:val", "--protocol", "streets"]
    report = ["--report", str(picture), "--json", str(file), "--model", str(tmp_path / "run")]
    report += ["--beside", "simulated:2:test"]
    words, few = [*words, *report], words
    assert main(words) == 0
    out = capsys.readouterr().out
    assert "drop_run_lengths" in out
    assert out.count("another real") == 2
    assert "building, median range [m]" in out
    found = json.loads(file.read_text())
    assert (found["samples"], found["reference"]) == ("simulated:2", "simulated:2:val")
    assert {"simulated", "bernoulli", "real_against_real", "another_real", "ratio"} == set(found["curves"][0])
    assert set(found["figures"]) == {"simulated", "real", "another_real"}
    alone = [metric for metric in found["curves"] if metric["another_real"]["metric"] == "wall_straightness"]
    assert alone[0]["another_real"]["value"] == _distance("wall_straightness", "simulated:2:test", "simulated:2:val")
    kinds = ["simulated"] * 5 + ["real"] * 5 + ["real_triangulated"] * 5
    assert [score["scans"] for score in found["raydrop"]] == kinds
    assert picture.read_bytes().startswith(b"\x89PNG")
    Raydrop(Raydrop.smallest_config(SENSOR), SENSOR).save(tmp_path / "drops")
    file.unlink()
    assert main([*few, "--model", str(tmp_path / "drops"), "--json", str(file)]) == 0  # a network without a tokenizer
    assert [score["scans"] for score in json.loads(file.read_text())["raydrop"]] == kinds[:5] + kinds[10:]
    assert main(words) == 2  # it is there already
    assert "add --overwrite" in capsys.readouterr().err
    assert main([*words, "--overwrite", "--device", "cuda:99"]) == 2
    assert "device 'cuda:99'" in capsys.readouterr().err
    monkeypatch.setattr(realism, "simulate_pair", lambda *_: pytest.fail("it simulates before it looks"))
    for wrong, got in (
        (["evaluate", "simulated:2", "simulated:1", *few[3:]], "got 1 real scan; wanted at least 2"),
        ([*few, "-n", "1"], "got 1 simulated scan; wanted at least 2"),
        (["evaluate", "simulated:2@vlp16", *few[2:]], "got streets of 'vlp16' and scans of 'hdl64e_kitti_odometry'"),
        ([*few, "--pixel-statistics"], "got --pixel-statistics with --protocol streets"),
        (["evaluate", "simulated:2", "simulated:2", "--model", "pretrained"], "got --model without --protocol streets"),
        ([*few[:3], "--beside", "simulated:2"], "got --beside without --protocol streets"),
        ([*few, "--beside", "nowhere"], "got nowhere, which"),
        ([*few, "--report", str(tmp_path / "curves.html")], "curves.html, which will hold"),
    ):
        assert main(wrong) == 2
        assert got in capsys.readouterr().err


def test_other_samples_are_scored_by_the_curves_of_streets_alone(tmp_path, capsys):
    torch.manual_seed(0)
    LidarGrit(LidarGrit.smallest_config(SENSOR), SENSOR).save(tmp_path / "run")
    assert main(["sample", str(tmp_path / "run"), str(tmp_path / "samples"), "-n", "2"]) == 0
    words = ["evaluate", str(tmp_path / "samples"), "simulated:2", "--protocol", "streets", "--intervals", "0"]
    assert main([*words, "--json", str(tmp_path / "scores.json")]) == 0
    found = json.loads((tmp_path / "scores.json").read_text())
    assert {score["metric"] for score in found["scores"]} | {each["metric"] for each in found["left_out"]} == {*CURVES}

"""Protocols, scorecards and tables: what is compared, what is told of it, and what never stands side by side."""

import itertools
import json
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidargrit.cli import main
from lidargrit.core import discovery
from lidargrit.core.errors import DataError, LidarGritError, UnknownNameError
from lidargrit.core.files import write_json
from lidargrit.core.table import render
from lidargrit.data.images import Pixels, Provenance
from lidargrit.data.prepared.config import DataConfig, ScanSettings
from lidargrit.data.sources import open_source
from lidargrit.evaluation.evaluate import EvalConfig, evaluate_sources, read_config
from lidargrit.evaluation.intervals import Resampling
from lidargrit.evaluation.metrics import load_metric
from lidargrit.evaluation.pairs import pair_for_protocol
from lidargrit.evaluation.protocols import MetricChoice, Protocol, load_protocol
from lidargrit.evaluation.scorecard import Scorecard, format_value
from lidargrit.evaluation.tables import published, side_by_side
from lidargrit.scans.sensors import load_sensor
from tiny_runs import the_one_line

CHEAP = ("return_rate_per_ring", "bev_occupancy")
SENSOR = load_sensor("hdl64e_kitti_odometry")
PROTOCOLS = discovery.names("protocols")


class WithReflectance:
    """Eight seeded range images with reflectance."""

    provenance = Provenance()

    def __len__(self) -> int:
        return 8

    def read(self, index: int) -> Pixels:
        rng = np.random.default_rng(index)
        size = (SENSOR.height, SENSOR.width * SENSOR.column_stride)
        range_m = rng.uniform(2, 60, size).astype(np.float32)
        return Pixels(range_m, {"reflectance": rng.uniform(0, 1, size).astype(np.float32)})


def write_scans(folder, count, seed, variant=""):
    """Write range images as another program would, or with a manifest as this one does."""
    rng = torch.Generator().manual_seed(seed)
    smooth = torch.rand(count, 64, 32, generator=rng).repeat_interleave(8, dim=2)
    range_m = (2 + 60 * smooth) * (torch.rand(count, 64, 256, generator=rng) < 0.8)
    folder.mkdir()
    for index in range(count):
        if variant:
            np.savez_compressed(folder / f"{index:08d}.npz", range_m=range_m[index].numpy())
        else:
            torch.save(range_m[index][None].clone(), folder / f"{index}.pth")
    if variant:
        sensor = load_sensor("hdl64e_kitti_odometry").to_json()
        write_json(folder / "samples.json", {"sensor": sensor, "projection_variant": variant})
    return str(folder)


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sets")
    return write_scans(folder / "generated", 12, 0), write_scans(folder / "real", 10, 1)


@pytest.fixture(scope="module")
def card(sets):
    return evaluate_sources(*sets, EvalConfig(metrics=CHEAP))[0]


@pytest.mark.parametrize("name", PROTOCOLS)
def test_a_protocol_asks_for_what_there_is(name):
    protocol = load_protocol(name.replace("_", "-").upper())
    assert protocol.title
    assert protocol.source
    for choice in protocol.metrics:
        assert choice.variant in load_metric(choice.metric).variants
    sensor = protocol.load_sensor()
    assert (sensor is None) == (name in ("drive", "exact", "forecast", "objects", "streets"))
    if sensor is not None:
        rows = 32 if protocol.data_set == "nuscenes" else 64
        assert (sensor.height, sensor.width) == (rows, 256 if name.endswith("odometry") else 1024)
        assert protocol.data_set in discovery.names("datasets")
    assert 20 < len(discovery.summary("protocols", name)) < 180


def test_the_papers_protocol_is_the_papers():
    protocol = load_protocol("lidargrit-kitti-360")
    sensor = protocol.load_sensor()
    assert sensor is not None
    assert (sensor.column_stride, protocol.variant, protocol.num_scans, protocol.range_m) == (
        2,
        "reference",
        5000,
        (1.45, 80.0),
    )
    with pytest.raises(UnknownNameError, match="lidargrit_kitti_360"):
        load_protocol("lidargrit-360")


@pytest.mark.parametrize("name", ["lidargen", "r2dm"])
def test_protocols_name_the_half_pixel_by_which_a_program_moves_points(name):
    assert any("half a row and half a column" in line for line in load_protocol(name).departures)


def test_a_scorecard_tells_all_that_is_needed_to_repeat_it(card):
    data = json.loads(json.dumps(card.to_json()))
    assert data["protocol"]["name"] == "exact"
    assert data["samples"] == card.samples.source
    assert data["inputs"]["samples"]["scans"] == 12
    assert data["inputs"]["reference"]["scans_used"] == 10
    assert (data["inputs"]["reference"]["data_set"], data["inputs"]["reference"]["split"]) == ("samples", "lidargrit")
    assert data["inputs"]["samples"]["sha256"] != data["inputs"]["reference"]["sha256"]
    assert data["settings"]["resampling"] == {"groups": 16, "halves": 20, "seed": 0}
    assert {"lidargrit", "python", "torch", "numpy", "scipy"} <= set(data["versions"])
    for score in data["scores"]:
        assert score["num_generated"] == score["num_reference"] == 10
        assert score["interval"]["low"] <= score["value"] <= score["interval"]["high"]
        assert score["real_against_real"]["num_scans"] == 5
        assert score["seconds"] >= 0
    assert data["verdict"][0].startswith("No verdict: 10 scans in each set")


def test_the_same_again_gives_the_same(card, sets):
    again = evaluate_sources(*sets, EvalConfig(metrics=CHEAP))[0]
    without = [replace(score, seconds=0.0) for score in card.scores]
    assert [replace(score, seconds=0.0) for score in again.scores] == without
    assert again.samples == card.samples
    assert {len(each) for each in (card.about["sha256"], card.versions["source_sha256"])} == {64}


def test_no_intervals_where_none_are_wanted(card, sets):
    plain = evaluate_sources(*sets, EvalConfig(metrics=CHEAP, resampling=Resampling(halves=0)))[0]
    assert all(score.interval is None and score.real_against_real is None for score in plain.scores)
    assert [s.result.value for s in plain.scores] == pytest.approx([s.result.value for s in card.scores])
    assert "0.0" in plain.as_table()


def test_a_metric_that_cannot_be_had_leaves_the_others(monkeypatch, tmp_path, sets):
    monkeypatch.setenv("LIDARGRIT_WEIGHTS", str(tmp_path))
    missing = tmp_path / "none.pth"
    settings = EvalConfig(
        metrics=(*CHEAP, "frechet_pointcloud_distance"), weights={"pointnet": missing}, resampling=Resampling(halves=0)
    )
    card = evaluate_sources(*sets, settings)[0]
    assert [score.result.metric for score in card.scores] == list(CHEAP)
    assert {each.metric for each in card.left_out} == {"frechet_pointcloud_distance"}
    assert "none.pth" in card.left_out[0].why
    line = next(line for line in card.as_table().splitlines() if line.startswith("left out:"))
    assert "frechet_pointcloud_distance: got" in line
    write_json(tmp_path / "mine.json", card.to_json())
    assert "mine: left out: frechet_pointcloud_distance" in render(side_by_side([tmp_path / "mine.json"]))
    with pytest.raises(LidarGritError, match=r"none\.pth"):
        evaluate_sources(*sets, replace(settings, metrics=("frechet_pointcloud_distance",)))


def test_what_is_not_as_the_protocol_wants_is_told():
    scans = open_source("simulated:3:train"), open_source("simulated:3:test")
    pair = pair_for_protocol(*scans, load_protocol("lidargrit-kitti-odometry"), DataConfig(max_scans=2))
    deviations = " | ".join(pair.deviations)
    assert "2 of the 5,000 scans" in deviations
    assert "the reference is simulated, not kitti_odometry" in deviations
    assert "projected by 'exact', not by 'reference'" in deviations
    assert len(pair.samples) == len(pair.reference) == 2
    other = pair_for_protocol(*scans, load_protocol("exact"), DataConfig())
    assert other.deviations == ()


def test_returns_outside_the_window_are_none(sets):
    protocol = Protocol("t", "s", (MetricChoice("sliced_wasserstein"),), range_m=(5.0, 20.0))
    batch = pair_for_protocol(*map(open_source, sets), protocol, DataConfig()).samples.batch([0, 1])
    returned = batch.range_m[batch.return_mask]
    assert float(returned.min()) > 5
    assert float(returned.max()) < 20


def test_words_of_reading_scans_are_obeyed_or_refused(tmp_path, capsys):
    named = read_config(ScanSettings.read(["data.projection_variant=reference", "data.max_scans=7"]))
    assert named.projection_variant == "reference"
    assert named.max_scans == 7
    assert read_config(ScanSettings.read(["data.max_scans=7"]), max_scans=3).max_scans == 3
    assert main(["evaluate", "pretrained", "simulated:2:test"]) == 2
    error = the_one_line(capsys.readouterr().err, "evaluate")
    assert "got the run pretrained, which holds no scans" in error
    assert "lidargrit likelihood simulated:2:test --model pretrained" in error
    for words, got in ((["a", "b", "--report", str(tmp_path / "r.png")], "r.png, which will hold HTML"),):
        assert main(["evaluate", *words]) == 2
        assert got in the_one_line(capsys.readouterr().err, "evaluate")


def test_options_that_change_no_score_are_refused(sets, tmp_path, capsys):
    ours = write_scans(tmp_path / "ours", 2, 3, variant="exact")
    weights = ["--weights", f"pointnet={tmp_path / 'weights.pth'}"]
    for words, got in (
        ([ours, sets[1], "--sensor", "vlp16"], f"--sensor vlp16 for {ours}, which holds generated range images"),
        ([*sets, "--sensor", "vlp16"], f"--sensor vlp16 for {sets[0]}, which holds generated range images"),
        ([*sets, "--set", "data.columns=1024"], "--set data.columns=1024 data.column_stride=1 for"),
        ([*sets, *weights], "weights.pth, which none of the chosen metrics needs; wanted no weights"),
        (
            [*sets, *weights, "--metrics", "frechet_range_distance"],
            "weights.pth, which none of the chosen metrics needs; wanted weights of rangenet53",
        ),
    ):
        assert main(["evaluate", *words]) == 2
        assert got in the_one_line(capsys.readouterr().err, "evaluate")


def test_files_of_one_name_are_told_apart_and_rows_complete_each_other(card, tmp_path):
    paths = [tmp_path / folder / "scores.json" for folder in ("a", "b")]
    for path, scores in zip(paths, (card.scores[:1], card.scores), strict=True):
        path.parent.mkdir()
        write_json(path, replace(card, scores=scores).to_json())
    table = render(side_by_side(paths))
    assert all(str(path.with_suffix("")) in table for path in paths)
    (real,) = (line for line in table.splitlines() if line.startswith("(real against real"))
    assert all(format_value(score.real_against_real.value) in real for score in card.scores)
    bounds = [path.with_name("marginal.json") for path in paths]
    for path in bounds:
        write_json(path, card.to_json())
    table = render(side_by_side([*paths, *bounds]))
    assert table.count("marginal (pixel statistics)") == 2
    assert not re.search(r"marginal: (Better|Within)", table)


def test_sets_that_overlap_and_projections_that_differ_are_told(sets, tmp_path):
    plain = EvalConfig(metrics=CHEAP, resampling=Resampling(halves=0))
    samples = write_scans(tmp_path / "samples", 3, 7, variant="exact")
    twice, _ = evaluate_sources(samples, samples, plain)
    assert "overlap (3 scans are in both)" in twice.leak
    assert any("overlap (3 scans are in both)" in sentence for sentence in twice.verdict.sentences)
    assert "the order is SAMPLES REFERENCE" in " ".join(
        evaluate_sources("simulated:3:test", samples, plain)[0].warnings
    )
    same, _ = evaluate_sources(sets[0], sets[0], plain)
    assert "overlap (12 scans are in both)" in same.leak
    assert [score.result.value for score in same.scores] == [0.0, 0.0]
    ours = [write_scans(tmp_path / name, 4, 5, variant=name) for name in ("exact", "reference")]
    for samples, differs in zip(ours, (True, False), strict=True):
        card, pair = evaluate_sources(samples, sets[1], plain)
        assert any("projections differ" in warning for warning in card.warnings) == differs
        assert pair.samples.record().projection == f"unfolding, {'exact' if differs else 'reference'}"


def test_metrics_by_name_take_the_protocols_definitions():
    by_name = EvalConfig("r2dm", metrics=("bev-jsd", "sliced_wasserstein", "bev_jsd")).chosen_metrics()
    assert [(c.metric, c.variant) for c in by_name] == [
        ("bev_jsd", "r2dm"),
        ("sliced_wasserstein", "reference"),
        ("sliced_wasserstein", "textbook"),
    ]
    every = EvalConfig(metrics=("sliced_wasserstein",)).chosen_metrics()
    assert [c.variant for c in every] == ["reference", "textbook"]
    assert EvalConfig("r2dm", variant="exact").chosen_metrics()[0].variant == "exact"


def test_a_scorecard_is_read_back_and_nothing_else_is(card, tmp_path):
    path = tmp_path / "scores.json"
    write_json(path, card.to_json())
    again = Scorecard.read(path)
    assert again.as_table() == card.as_table()
    assert again.samples == card.samples
    assert {len(each) for each in (card.about["sha256"], card.versions["source_sha256"])} == {64}
    altered = path.read_text().replace('"scans_used": 10', '"scans_used": 11')
    path.write_text(altered)
    with pytest.raises(DataError, match=r"scores\.json, which was altered after it was written"):
        Scorecard.read(path)
    for bad in ("[]", "{}", "nonsense", '{"protocol": 1}', "[" * 100000):
        path.write_text(bad)
        with pytest.raises(DataError, match=r"scores\.json, which cannot be used"):
            Scorecard.read(path)
    data = card.to_json()
    data["scores"][0]["value"] = {"a": 1}
    write_json(path, data)
    with pytest.raises(DataError, match="evaluate again"):
        Scorecard.read(path)
    for name, bad in itertools.product(("interval", "real_against_real"), (0, "", [], False)):
        data = card.to_json()
        data["scores"][0][name] = bad
        write_json(path, data)
        with pytest.raises(DataError, match=r"scores\.json, which cannot be used"):
            Scorecard.read(path)
    with pytest.raises(DataError, match="no such file"):
        Scorecard.read(tmp_path / "none.json")


def as_if(card, protocol, deviations=(), sha256="ab" * 32):
    scores = tuple(
        replace(score, result=replace(score.result, metric=choice.metric, variant=choice.variant))
        for score, choice in zip(card.scores, load_protocol(protocol).metrics, strict=False)
    )
    reference = replace(card.reference, sha256=sha256)
    return replace(card, protocol=protocol, deviations=deviations, scores=scores, reference=reference)


def test_published_figures_stand_apart_and_only_beside_their_equals(card, tmp_path):
    paths = [tmp_path / f"{name}.json" for name in ("ours", "theirs", "elsewhere")]
    write_json(paths[0], as_if(card, "lidargrit_kitti_odometry").to_json())
    write_json(paths[1], as_if(card, "lidargrit_kitti_odometry").to_json())
    text = render(side_by_side(paths[:2]))
    measured, differences, *tables = text.split("\n\n")
    assert "ours" in measured
    assert "theirs" in measured
    assert differences.startswith("Differences: score minus that of ours")
    assert "DUSty" not in measured
    assert len(tables) == 2
    assert all(table.startswith("Published, not measured here:") for table in tables)
    assert "0.1515" in text  # printed as 15.15, times 100
    # Another reference stands in a block of its own, and what is not the protocol gets no published scores.
    deviant = as_if(card, "lidargrit_kitti_odometry", ("the reference is simulated, not kitti_odometry",), "cd" * 32)
    write_json(paths[2], deviant.to_json())
    text = render(side_by_side([paths[2]]))
    assert "DUSty" not in text
    assert "left out, for they do not compare: the reference is simulated" in text
    assert render(side_by_side(paths)).count("Measured, protocol") == 2
    write_json(paths[0], card.to_json())
    assert "ublished" not in render(side_by_side(paths[:1]))


def test_tables_can_be_set_in_markdown_and_latex(card, tmp_path):
    path = tmp_path / "100%_of|it.json"
    write_json(path, as_if(card, "lidargrit_kitti_odometry").to_json())
    markdown = render(side_by_side([path]), "markdown")
    assert r"100%\_of\|it" in markdown
    assert "| --- |" in markdown
    latex = render(side_by_side([path]), "latex")
    assert r"100\%\_of|it" in latex
    assert latex.count(r"\begin{tabular}") == latex.count(r"\end{tabular}") == 3
    with pytest.raises(DataError, match="no file of scores"):
        render(side_by_side([]))


def test_published_tables_are_whole():
    for table in published():
        protocol = load_protocol(table["protocol"])
        columns = [(column["metric"], column["variant"]) for column in table["columns"]]
        assert columns == [(choice.metric, choice.variant) for choice in protocol.metrics]
        assert "table" in table["source"]
        assert all(len(row["printed"]) == len(columns) for row in table["rows"])


@pytest.mark.parametrize(
    ("value", "text"), [(0.0, "0"), (0.12345, "0.1235"), (1.5e-4, "0.00015"), (12345.6, "1.235e+04"), (np.nan, "nan")]
)
def test_figures_have_four_digits(value, text):
    assert format_value(value) == text


def test_the_command_line_writes_scores_page_and_table(tmp_path, capsys, sets):
    words = ["evaluate", *sets, "--metrics", *CHEAP, "--intervals", "4"]
    files = ["--json", str(tmp_path / "s.json"), "--report", str(tmp_path / "s.html")]
    assert main([*words, *files]) == 0
    verdict, _, table = capsys.readouterr().out.partition("\n\n")
    assert verdict.startswith("No verdict: 10 scans in each set")
    head, *rows, _ = table.splitlines()
    assert " ".join(head.split()) == "metric variant score 95 % interval real against real better scans"
    assert len(rows) == 2
    assert (tmp_path / "s.html").read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    for wrong, message in (
        ([*words, *files], "there already"),
        (["evaluate", sets[0]], "alone; wanted samples and what they are compared with"),
        ([*words, "--weights", "pointnet"], "NAME=FILE"),
        ([*words, "--protocol", "r3dm"], "wanted one such as"),
        ([*words, "--groups", "2"], "--groups 2"),
    ):
        assert main(wrong) != 0
        assert message in capsys.readouterr().err

"""A comparison that is begun again: scores of weights that came since, the same seeds, and which limit held."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidargrit.core.errors import ConfigError
from lidargrit.data.images import RangeImages
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources import open_source
from lidargrit.evaluation import compare
from lidargrit.evaluation.compare import run as run_comparison
from lidargrit.evaluation.evaluate import EvalConfig
from lidargrit.evaluation.intervals import Resampling
from lidargrit.evaluation.pairs import EvalPair, EvalSet
from lidargrit.evaluation.protocols import load_protocol
from lidargrit.scans.sensors import load_sensor
from seeded_images import SeededImages
from seeded_networks import weights
from test_compare import COMPARISON

SENSOR = load_sensor("vlp16").with_columns(32)


def test_scores_are_computed_again_with_weights_that_came_since(tmp_path, heard):
    file, path = tmp_path / "weights.pth", tmp_path / "scores.json"
    metrics = "return_rate_per_ring", "frechet_pointcloud_distance"
    plain = Resampling(halves=0)
    settings = EvalConfig("lidargrit-kitti-odometry", metrics, weights={"pointnet": file}, resampling=plain)
    pair = EvalPair(*(EvalSet(name, RangeImages(SENSOR, [SeededImages(SENSOR, 4)]), range(2)) for name in "ab"))
    pair = replace(pair, samples=replace(pair.samples, indices=range(2, 4)))

    def scored():
        heard.clear()
        compare._score(pair, settings, path)
        there = json.loads(path.read_text())
        return there["scores"], there["left_out"], any("are there already" in line for line in heard)

    scores, left_out, _ = scored()
    assert [each["metric"] for each in left_out] == ["frechet_pointcloud_distance"]
    assert scored() == (scores, left_out, True), "no weights yet"
    torch.save(weights("pointnet"), file)
    first, left_out, kept = scored()
    assert ([score["metric"] for score in first], left_out, kept) == ([*metrics], [], False)
    assert scored() == (first, [], True)
    torch.save(weights("pointnet", seed=5), file)
    second, _, kept = scored()
    assert not kept
    assert second[1]["value"] != first[1]["value"]
    file.unlink()
    assert scored() == (second, [], True), "nothing to score with again"


def test_systems_that_sample_nothing_are_refused_before_others_are_trained(tmp_path):
    with pytest.raises(ConfigError, match=r"interpolation, which samples no new scans; .*: lidargrit complete SCANS"):
        run_comparison(["memorised", "interpolation"], tmp_path / "table", COMPARISON)
    assert not (tmp_path / "table").exists()


def test_scores_of_samples_called_costs_are_not_taken_for_their_costs(tmp_path, monkeypatch):
    made = run_comparison(["memorised"], tmp_path / "first", COMPARISON)
    shutil.copytree(tmp_path / "first" / "memorised" / "samples", tmp_path / "costs")
    monkeypatch.chdir(tmp_path)
    paths = run_comparison(["costs"], tmp_path / "second", replace(COMPARISON, preset_settings=()))
    values = [json.loads(path.read_text())["scores"][0]["value"] for path in (*made, *paths)]
    assert values[0] == values[1]


def test_a_folder_of_a_system_is_neither_the_page_nor_too_long_for_a_disk(tmp_path):
    deep = "/".join(["samples" * 8] * 8)
    assert {compare._folder_name(word) for word in ("marginal", "marginal/", "./marginal")} == {"marginal"}
    for system, name in (("table.html", "table.html_"), (f"{deep}/mine", f"{deep}/mine".replace("/", "_")[-200:])):
        assert compare._folder_name(system) == name
        (tmp_path / name).mkdir()
    assert len(compare._folder_name("é" * 200).encode()) <= 200


def test_scores_are_computed_again_for_other_reflectance_on_the_same_ranges(tmp_path):
    settings = EvalConfig(metrics=("reflectance_histogram",), resampling=Resampling(halves=0))

    def scored(reflectance):
        sets = (
            EvalSet(name, RangeImages(SENSOR, [SeededImages(SENSOR, 2, of)]), range(2))
            for name, of in (("a", reflectance), ("b", 0.5))
        )
        compare._score(EvalPair(*sets), settings, tmp_path / "scores.json")
        return json.loads((tmp_path / "scores.json").read_text())["scores"][0]["value"]

    assert [scored(of) for of in (0.5, 0.9)] == [0, 1]


def test_labels_that_alone_changed_are_scored_against_again(tmp_path):
    """Prepared sets are known by hashes of ranges and reflectance, of which labels are no part."""
    sequence = tmp_path / "scans" / "sequences" / "00"
    (sequence / "velodyne").mkdir(parents=True)
    (sequence / "labels").mkdir()
    for at, cloud in enumerate(np.random.default_rng(0).normal(0, 9, (2, 500, 4)).astype(np.float32)):
        (cloud * [1, 1, 0.1, 0]).astype(np.float32).tofile(sequence / "velodyne" / f"{at:06d}.bin")
    records = []
    for label in (40, 48, 0):
        for at in range(2):
            np.full(500, label, np.uint32).tofile(sequence / "labels" / f"{at:06d}.label")
        config = DataConfig(sensor="vlp16", columns=32, workers=1)
        images = open_source(f"kitti_odometry:{sequence.parent.parent}").images(SENSOR, config)
        records.append(EvalSet("scans", images, range(2)).record())
    assert len({record.sha256 for record in records}) == 1
    assert len({record.labels_sha256 for record in records}) == 3
    assert records[0] != records[1]


def test_a_few_samples_are_those_of_the_first_seeds(tmp_path):
    """They were spaced evenly over what an earlier comparison of more had left, unlike those of a system added now."""
    plain = replace(COMPARISON, settings=EvalConfig(metrics=("bev_jsd",), resampling=Resampling(halves=0)))
    run_comparison(["marginal"], tmp_path / "six", replace(plain, num_samples=6))
    found = [
        json.loads(run_comparison(["marginal"], tmp_path / name, replace(plain, num_samples=3))[0].read_text())
        for name in ("six", "three")
    ]
    six, three = (each["inputs"]["samples"] for each in found)
    assert six["sha256"] == three["sha256"]
    assert (six["scans"], six["scans_used"]) == (6, 3)


def test_it_is_told_which_limit_held(tmp_path, monkeypatch, heard):
    def told(folder, **changes):
        heard.clear()
        run_comparison(["marginal"], tmp_path / folder, replace(COMPARISON, **changes))
        (line,) = (line for line in heard if "as many are compared" in line)
        return line

    assert "simulated:6:test has 6 scans" in told("reference", reference="simulated:6:test")
    few = replace(load_protocol("exact"), num_scans=4)
    for module in ("compare.load_protocol", "evaluate.load_protocol"):
        monkeypatch.setattr(f"lidargrit.evaluation.{module}", lambda name: few)
    assert "protocol exact takes 4 scans" in told("protocol")

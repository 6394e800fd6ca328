"""Every difference from a protocol is told, columns are obeyed or refused, and errors of reconstruction no scores."""

import json
from dataclasses import replace

import numpy as np
import pytest

from lidargrit.core.errors import DataError, ScanError
from lidargrit.core.files import write_json
from lidargrit.core.table import render
from lidargrit.data.images import RangeImages
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.prepared.prepare import prepare
from lidargrit.evaluation.evaluate import EvalConfig, evaluate_pair, evaluate_sources
from lidargrit.evaluation.intervals import Resampling
from lidargrit.evaluation.pairs import EvalPair, EvalSet, deviations
from lidargrit.evaluation.protocols import load_protocol
from lidargrit.evaluation.tables import compare_systems, side_by_side
from lidargrit.scans.sensors import load_sensor
from seeded_images import SeededImages
from test_verdict import card, halved

ODOMETRY = load_sensor("hdl64e_kitti_odometry")
PLAIN = Resampling(halves=0)
BOTH = "samples are", "reference is"


def as_wanted(sensor=ODOMETRY, samples_variant="reference"):
    """Return a pair that is as the protocol of KITTI odometry wants it, apart from its number of scans."""
    images = RangeImages(sensor, [SeededImages(ODOMETRY, 2)])
    samples = EvalSet("a", images, range(2), data_set="samples", projection_variant=samples_variant)
    reference = EvalSet("b", images, range(2), data_set="kitti_odometry", split="test", projection_variant="reference")
    return EvalPair(samples, reference)


@pytest.mark.parametrize(
    ("pair", "told"),
    [
        (as_wanted(), []),
        (as_wanted(samples_variant=""), []),
        (as_wanted(samples_variant="exact"), ["the samples are projected by 'exact', not by 'reference'"]),
        (
            as_wanted(replace(ODOMETRY, range_max_m=60.0)),
            [f"the {name} of a sensor that sees 0.9 to 60 m, not 0.9 to 120 m" for name in BOTH],
        ),
        (
            as_wanted(replace(ODOMETRY, projection="spherical")),
            [f"the {name} in rows by elevation (spherical), not by ring (unfolding)" for name in BOTH],
        ),
    ],
)
def test_images_that_were_made_in_another_way_are_told(pair, told):
    protocol = replace(load_protocol("lidargrit-kitti-odometry"), num_scans=2)
    assert list(deviations(pair, protocol)) == told


def test_other_definitions_are_told_and_have_no_published_scores_beside_them(tmp_path):
    def scored(**settings):
        settings = EvalConfig("lidargrit-kitti-odometry", resampling=PLAIN, **settings)
        card = evaluate_pair(as_wanted(), settings)
        write_json(tmp_path / "ours.json", card.to_json())
        return card.deviations, render(side_by_side([tmp_path / "ours.json"]))

    told, table = scored(metrics=("sliced_wasserstein", "return_rate_per_ring"))
    assert told == (), "a metric that the protocol does not have changes none of its own"
    assert "DUSty" in table
    told, table = scored(metrics=("sliced_wasserstein",), variant="textbook")
    assert told == ("sliced_wasserstein is computed by the definition textbook, not by reference",)
    assert "DUSty" not in table
    every = evaluate_pair(as_wanted(), EvalConfig(metrics=("sliced_wasserstein",), resampling=PLAIN))
    assert len(every.scores) == 2
    assert every.deviations == (), "the protocol's own is among them"


def test_scores_through_other_weights_are_not_said_to_be_better():
    def system(value, sha256):
        rng, metrics = np.random.default_rng(1), ("bev_jsd", "frechet_pointcloud_distance")
        plain, through = (halved(rng, value, 0, metric) for metric in metrics)
        details = {"weights": {"file": "w.pth", "sha256": sha256}}
        return card(plain, replace(through, result=replace(through.result, details=details)))

    alike = compare_systems("b", system(0.5, "1"), "a", system(1.0, "1"))
    assert "better in 2" in alike.verdict.sentences[0]
    found = compare_systems("b", system(0.5, "2"), "a", system(1.0, "1"))
    assert [metric for metric, _ in found.differences] == ["bev_jsd"]
    tally, remark = found.verdict.sentences
    assert "better in 1 (bev_jsd), undecided in 1 (frechet_pointcloud_distance)" in tally
    assert remark == "Scored through other weights of a network, so undecided: frechet_pointcloud_distance."


def test_columns_without_a_sensor_are_those_of_prepared_scans(tmp_path):
    wide = DataConfig(columns=256, workers=1)
    names = [str(prepare(f"simulated:2:{split}", wide, tmp_path / split)) for split in ("train", "test")]
    settings = EvalConfig(metrics=("return_rate_per_ring",), resampling=PLAIN, data=DataConfig(columns=128, workers=1))
    card, pair = evaluate_sources(*names, settings)
    assert pair.samples.images.sensor.width == pair.reference.images.sensor.width == 128
    assert (card.settings["columns"], card.settings["column_stride"]) == (128, 1)
    card, pair = evaluate_sources(*names, replace(settings, data=DataConfig(workers=1)))
    assert pair.samples.images.sensor.width == 256
    assert not {"columns", "column_stride"} & card.settings.keys()
    with pytest.raises(DataError, match=r"64x256.*; wanted the rays of .*64x512"):
        evaluate_sources(*names, replace(settings, data=DataConfig(columns=512, workers=1)))
    with pytest.raises(DataError, match=r"prepared by the projection exact, unfolding, .* wanted exact, spherical"):
        evaluate_sources(*names, replace(settings, data=DataConfig(projection="spherical", workers=1)))


def test_columns_without_a_sensor_are_those_of_range_images(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        for index in range(2):
            np.save(tmp_path / name / f"{index}.npy", SeededImages(ODOMETRY, 2).read(index).range_m)
    settings = EvalConfig(metrics=("return_rate_per_ring",), resampling=PLAIN, data=DataConfig(columns=128))
    with pytest.raises(ScanError, match="a range image of 64x256; wanted 64x128"):
        evaluate_sources(str(tmp_path / "a"), str(tmp_path / "b"), settings)


def test_errors_of_reconstruction_are_no_row_of_a_table(tmp_path):
    path = tmp_path / "run.json"
    path.write_text(json.dumps({"samples": "runs/mine", "reference": "x", "reconstruction": {"range_mae_m": 1.0}}))
    with pytest.raises(DataError, match=r"holds errors of reconstruction; wanted scores of samples.*lidargrit sample"):
        render(side_by_side([path]))

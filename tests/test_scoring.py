"""Scores of metrics that are fed together: features computed once, the same numbers as one by one, failures apart."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lidargrit.core.errors import ConfigError, LidarGritError, UnknownNameError
from lidargrit.data.images import Pixels, Provenance, RangeImages
from lidargrit.evaluation.evaluate import EvalConfig
from lidargrit.evaluation.intervals import Resampling, Score
from lidargrit.evaluation.metrics import load_metric
from lidargrit.evaluation.metrics.shared.networks.network import PretrainedNetwork
from lidargrit.evaluation.pairs import EvalPair, EvalSet
from lidargrit.evaluation.protocols import MetricChoice
from lidargrit.evaluation.scoring import MetricFactory, score_metrics
from lidargrit.scans.sensors import SensorModel, column_azimuths_rad
from seeded_networks import weights_folder

SENSOR = SensorModel(
    "small kitti_360", torch.linspace(0.05, -0.4, 4)[:, None], column_azimuths_rad(32), 1.0, 80.0, "spherical"
)
POINTNET = [
    MetricChoice("frechet_pointcloud_distance", "lidargrit"),
    MetricChoice("frechet_pointcloud_distance", "r2dm"),
    MetricChoice("kernel_pointcloud_distance", "exact"),
    MetricChoice("frechet_pointcloud_distance", "exact"),
]


class Seeded:
    """Images of one sensor, each from its own seed."""

    provenance = Provenance()

    def __init__(self, count, first_seed):
        self._count, self._first_seed = count, first_seed

    def __len__(self):
        return self._count

    def read(self, index):
        rng = np.random.default_rng(self._first_seed + index)
        range_m = rng.uniform(2, 78, (SENSOR.height, SENSOR.width)).astype(np.float32)
        return Pixels(range_m * (rng.random(range_m.shape) < 0.8))


def pair_of(count):
    sets = [
        EvalSet(name, RangeImages(SENSOR, [Seeded(count, seed)]), range(count))
        for name, seed in (("generated", 0), ("real", 10_000))
    ]
    return EvalPair(*sets)


@pytest.fixture
def passes(monkeypatch):
    """Replace the network by one that returns a few numbers of each input, and count its inputs."""
    counts = []

    def forward(self, inputs):
        counts.append(len(inputs))
        return inputs.flatten(1)[:, 5:13].numpy()

    monkeypatch.setenv("LIDARGRIT_WEIGHTS", str(weights_folder()))
    monkeypatch.setattr(PretrainedNetwork, "_forward", forward)
    return counts


@pytest.mark.parametrize("resampling", [Resampling(4, 2), Resampling(halves=0)])
def test_every_scan_passes_the_network_once_for_each_kind_of_input(passes, resampling):
    count = 520
    found = score_metrics([MetricFactory(spec) for spec in POINTNET], pair_of(count), resampling)
    assert all(isinstance(score, Score) for score in found)
    # The programs want equal inputs on KITTI-360, and our own definition wants others.
    assert sum(passes) == 2 * 2 * count
    passes.clear()
    score_metrics([MetricFactory(spec) for spec in POINTNET[2:]], pair_of(count), resampling)
    assert sum(passes) == 2 * count


def test_metrics_fed_together_score_as_alone(passes):
    specs = [
        *POINTNET,
        MetricChoice("bev_jsd", "exact"),
        MetricChoice("bev_mmd", "exact"),
        MetricChoice("coverage", "exact"),
        MetricChoice("point_cloud_jsd", "exact"),
        MetricChoice("drop_correlation"),
    ]
    pair, resampling = pair_of(24), Resampling(4, 3)
    together = score_metrics([MetricFactory(spec) for spec in specs], pair, resampling)
    alone = [score_metrics([MetricFactory(spec)], pair, resampling)[0] for spec in specs]
    assert [replace(score, seconds=0.0) for score in together] == [replace(score, seconds=0.0) for score in alone]
    assert [score.result.metric for score in together] == [spec.metric for spec in specs]
    for spec, score in zip(specs, together, strict=True):
        metric = load_metric(spec.metric)(variant=spec.variant or None)
        for real, images in ((False, pair.samples), (True, pair.reference)):
            metric.update(images.batch(range(24)), real=real)
        assert score.result.value == pytest.approx(metric.compute().value, rel=1e-9)


def test_a_metric_that_fails_leaves_the_others_their_scores(passes):
    specs = [
        MetricChoice("frechet_pointcloud_distance", "nonsense"),
        MetricChoice("frechet_pointcloud_distance", "exact"),
        MetricChoice("reflectance_histogram"),
        MetricChoice("no_metric"),
        MetricChoice("drop_correlation"),
    ]
    factories = [MetricFactory(spec) for spec in specs]
    factories.append(replace(factories[1], weights=Path("nowhere.pth")))
    found = score_metrics(factories, pair_of(6), Resampling(halves=0))
    assert [isinstance(each, LidarGritError) for each in found] == [True, False, True, True, False, True]
    assert "variant 'nonsense'" in str(found[0])
    assert "without reflectance" in str(found[2])
    assert "'no_metric', which is not among the metrics" in str(found[3])
    assert "nowhere.pth" in str(found[5])


@pytest.mark.parametrize(
    ("words", "error", "why"),
    [
        ({"metrics": ("bev_jds",)}, UnknownNameError, "bev_jsd"),
        ({"protocol": "r2mm"}, UnknownNameError, "r2dm"),
        ({"variant": "exakt"}, ConfigError, "exact"),
        ({"seed": -1}, ConfigError, "a seed from 0 to"),
        (
            {"pixel_statistics": True, "resampling": Resampling(halves=0)},
            ConfigError,
            "--intervals 0; wanted intervals",
        ),
    ],
)
def test_wrong_words_are_refused_before_anything_is_opened(words, error, why):
    with pytest.raises(error, match=why):
        EvalConfig(**words)

"""Pixel statistics of real scans: what is shuffled, and what they score beside real scans."""

import numpy as np
import pytest
import torch

from lidargrit.data.images import Pixels, Provenance, RangeImages
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources import load_range_images
from lidargrit.evaluation import scoring as module
from lidargrit.evaluation.evaluate import EvalConfig, evaluate_pair
from lidargrit.evaluation.intervals import Resampling
from lidargrit.evaluation.pairs import EvalPair, EvalSet
from lidargrit.evaluation.scoring import pixel_statistics
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(32)


class IndependentPixels:
    """Range images whose pixels know nothing of each other; reflectance tells from which scan a pixel is."""

    provenance = Provenance()

    def __init__(self, count: int, seed: int = 0) -> None:
        rng, self.size = np.random.default_rng(seed), (count, SENSOR.height, SENSOR.width * SENSOR.column_stride)
        self.range_m = (rng.uniform(2, 60, self.size) * (rng.random(self.size) < 0.7)).astype(np.float32)

    def __len__(self) -> int:
        return self.size[0]

    def read(self, index: int) -> Pixels:
        reflectance = np.full(self.size[1:], (index + 1) / (1 + len(self)), np.float32)
        return Pixels(self.range_m[index], {"reflectance": reflectance * (self.range_m[index] > 0)})


def pair_of(count: int, seed: int = 0) -> EvalPair:
    images = RangeImages(SENSOR, [IndependentPixels(2 * count, seed)])
    return EvalPair(EvalSet("a", images, range(count)), EvalSet("b", images, range(count, 2 * count)))


def sorted_by_pixel(images: RangeImage) -> tuple[torch.Tensor, torch.Tensor]:
    """Return range and reflectance of each pixel over all scans, in the order of its ranges."""
    assert images.reflectance is not None
    ranges_m, order = images.range_m.sort(dim=0, stable=True)
    return ranges_m, images.reflectance.gather(0, order)


@pytest.mark.parametrize("at_once", [1 << 24, 4 * SENSOR.height * SENSOR.width])
def test_each_pixel_keeps_its_values_and_they_come_from_other_scans(at_once, monkeypatch):
    monkeypatch.setattr(module, "_PIXELS_AT_ONCE", at_once)
    scans, indices = pair_of(12).samples, [1, 2, 5, 6, 7, 8, 9, 10, 11]
    batches = list(pixel_statistics(scans, indices, seed=3))
    assert len(batches) == (1 if at_once == 1 << 24 else 2)
    shuffled, real = RangeImage.cat(batches), scans.batch(indices)
    for found, expected in zip(sorted_by_pixel(shuffled), sorted_by_pixel(real), strict=True):
        assert torch.equal(found, expected)
    for image in shuffled.reflectance:
        assert len(set(image[image > 0].tolist())) >= 4, "all scans of a batch are in each image"
    again, other = (next(pixel_statistics(scans, indices, seed)) for seed in (3, 4))
    assert torch.equal(again.range_m, batches[0].range_m)
    assert not torch.equal(other.range_m, batches[0].range_m)


def test_where_pixels_are_independent_they_score_like_real_scans():
    metrics = ("range_histogram_per_ring", "bev_jsd", "drop_run_lengths", "reflectance_histogram")
    config = EvalConfig(metrics=metrics, resampling=Resampling(halves=4), pixel_statistics=True)
    ratios = []
    for seed in range(4):
        for score in evaluate_pair(pair_of(16, seed), config).scores:
            assert score.real_against_real is not None
            assert score.pixel_statistics is not None
            if score.result.metric in ("range_histogram_per_ring", "bev_jsd") and score.result.variant == "exact":
                ratios.append(score.pixel_statistics / score.real_against_real.value)
    assert np.mean(ratios) == pytest.approx(1, abs=0.02)  # drawn with replacement they would score 1.2


def test_they_know_no_scan_that_they_are_compared_with_and_no_shape():
    real = load_range_images(("simulated:24:test",), DataConfig(columns=512, column_stride=8))
    pair = EvalPair(EvalSet("a", real, range(12)), EvalSet("b", real, range(12, 24)))
    metrics = ("range_histogram_per_ring", "return_rate_by_incidence")
    config = EvalConfig(metrics=metrics, resampling=Resampling(groups=12, halves=2), pixel_statistics=True)
    rows, incidence = evaluate_pair(pair, config).scores
    assert rows.real_against_real is not None
    assert incidence.real_against_real is not None
    assert rows.pixel_statistics == pytest.approx(rows.real_against_real.value, rel=0.15)
    assert incidence.pixel_statistics > 1.4 * incidence.real_against_real.value


def test_too_few_scans_are_told():
    config = EvalConfig(metrics=("bev_jsd",), variant="exact", pixel_statistics=True)
    card = evaluate_pair(pair_of(3), config)
    assert [score.pixel_statistics for score in card.scores] == [None]
    assert "too few scans for pixel statistics of bev_jsd" in card.warnings

"""Two sets of range images → scores: whichever of them are samples, scans on disk, or simulated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lidargrit.datasets import open_dataset
from lidargrit.errors import ConfigError
from lidargrit.evaluation.reconstruction import ReconstructionErrors, ReconstructionScore
from lidargrit.evaluation.samples import is_sample_folder, read_samples
from lidargrit.loading import DataConfig, RangeImages, load_range_images
from lidargrit.metrics import load_metric
from lidargrit.projection import Variant
from lidargrit.reporting import Reporter
from lidargrit.sensors import SensorModel
from lidargrit.structures import MetricResult
from lidargrit.tokenizers import Tokenizer

_BATCH = 16


def open_images(
    source: str,
    sensor: SensorModel | None = None,
    max_scans: int = 0,
    variant: Variant = "exact",
    reporter: Reporter | None = None,
) -> RangeImages:
    """Open a folder of samples, or any source of scans as range images of a sensor.

    Args:
        source: a folder of samples, or what data sets are opened by ("kitti_raw:ROOT:SPLIT", "FOLDER", ...).
        sensor: of scans; the data set's own if not given. Samples have theirs.
        max_scans: at most so many; 0 for all.
        variant: of the projection of scans.
        reporter: hears of the projection.
    """
    if is_sample_folder(Path(source)):
        return read_samples(Path(source), max_scans or None)
    dataset = open_dataset(source)
    config = DataConfig(train=(source,), val=(), sensor=dataset.sensor, max_scans=max_scans, variant=variant)
    return load_range_images((source,), config, reporter, sensor)


def evaluate(
    generated: RangeImages, reference: RangeImages, metrics: Sequence[str], variant: str | None = None, seed: int = 0
) -> list[MetricResult]:
    """Score generated range images against real ones; equal numbers of both are compared.

    Args:
        generated: the first ones are taken if there are more of them than of
        reference: likewise.
        metrics: names of metrics; each is computed in every variant it has, or in
        variant: this one.
        seed: of whatever a metric draws.

    Raises:
        ConfigError: the two sets look along different rays.
        DataError: too few scans.
    """
    if not generated.sensor.same_rays(reference.sensor):
        raise ConfigError(
            f"range images of {generated.sensor.name!r} ({generated.sensor.height}x{generated.sensor.width})",
            f"the rays of {reference.sensor.name!r} ({reference.sensor.height}x{reference.sensor.width})",
            "project the scans with the samples' sensor: give the samples first, the scans second",
        )
    count = min(len(generated), len(reference))
    classes = [load_metric(name) for name in metrics]
    running = [cls(variant=each, seed=seed) for cls in classes for each in ([variant] if variant else cls.variants)]
    for first in range(0, count, _BATCH):
        indices = range(first, min(first + _BATCH, count))
        generated_batch, real_batch = generated.batch(indices), reference.batch(indices)
        for metric in running:
            metric.update(generated_batch, real=False)
            metric.update(real_batch, real=True)
    return [metric.compute() for metric in running]


def score_reconstruction(tokenizer: Tokenizer, images: RangeImages) -> ReconstructionErrors:
    """Return how well a tokenizer gives back every scan of a set, its mask decoded by threshold."""
    score = ReconstructionScore()
    for first in range(0, len(images), _BATCH):
        batch = images.batch(range(first, min(first + _BATCH, len(images))))
        clean = tokenizer.decode_parts(tokenizer.encode(batch))
        score.update(batch, clean.range_m, clean.return_logits >= 0)
    return score.compute()


def as_json(results: Sequence[MetricResult]) -> list[dict[str, Any]]:
    """Return scores for a file."""
    return [asdict(result) for result in results]


def as_table(results: Sequence[MetricResult]) -> str:
    """Return scores as lines for a terminal."""
    lines = [f"{'metric':<22}{'variant':<12}{'value':>10}   {'better':<8}{'scans':>12}"]
    for result in results:
        better = "higher" if result.higher_is_better else "lower"
        scans = f"{result.num_generated} v {result.num_reference}"
        lines.append(f"{result.metric:<22}{result.variant:<12}{result.value:>10.4f}   {better:<8}{scans:>12}")
    return "\n".join(lines)

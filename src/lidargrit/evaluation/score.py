"""Two sets of range images → scores: whichever of them are samples, scans on disk, or simulated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from lidargrit.datasets import open_dataset
from lidargrit.errors import ConfigError
from lidargrit.evaluation.reconstruction import ReconstructionErrors, ReconstructionScore
from lidargrit.evaluation.samples import is_sample_folder, read_samples
from lidargrit.generators import load
from lidargrit.generators.lidargrit import LidarGrit
from lidargrit.loading import DataConfig, RangeImages, load_range_images, spread
from lidargrit.metrics import load_metric
from lidargrit.reporting import Reporter
from lidargrit.sensors import SensorModel
from lidargrit.structures import MetricResult
from lidargrit.tokenizers import Tokenizer

_BATCH = 16


def open_images(
    source: str,
    sensor: SensorModel | None = None,
    config: DataConfig | None = None,
    reporter: Reporter | None = None,
) -> RangeImages:
    """Open a folder of samples, or any source of scans as range images of a sensor.

    Args:
        source: a folder of samples, or what data sets are opened by ("kitti_raw:ROOT:SPLIT", "FOLDER", ...).
        sensor: of scans; the data set's own if not given. Samples have theirs.
        config: how scans are read and projected, and how many at most; its sources and its sensor are not looked at.
        reporter: hears of the projection.
    """
    config = config or DataConfig()
    if is_sample_folder(Path(source)):
        return read_samples(Path(source), config.max_scans or None)
    dataset = open_dataset(source, config.bad_points)
    return load_range_images((source,), replace(config, sensor=dataset.sensor), reporter, sensor)


def evaluate(
    generated: RangeImages, reference: RangeImages, metrics: Sequence[str], variant: str | None = None, seed: int = 0
) -> list[MetricResult]:
    """Score generated range images against real ones; equal numbers of both are compared.

    Args:
        generated: where there are more of them than of the others, they are taken evenly spaced.
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
    taken, real = spread(count, len(generated)), spread(count, len(reference))
    for first in range(0, count, _BATCH):
        generated_batch, real_batch = (
            images.batch(chosen[first : first + _BATCH]) for images, chosen in ((generated, taken), (reference, real))
        )
        for metric in running:
            metric.update(generated_batch, real=False)
            metric.update(real_batch, real=True)
    return [metric.compute() for metric in running]


@torch.no_grad()
def score_reconstruction(tokenizer: Tokenizer, images: RangeImages) -> ReconstructionErrors:
    """Return how well a tokenizer gives back every scan of a set, its mask decoded by threshold."""
    score = ReconstructionScore()
    for first in range(0, len(images), _BATCH):
        batch = images.batch(range(first, min(first + _BATCH, len(images))))
        clean = tokenizer.decode_parts(tokenizer.encode(batch))
        score.update(batch, clean.range_m, clean.return_logits >= 0)
    return score.compute()


def evaluate_run(run_folder: Path, source: str, config: DataConfig, reporter: Reporter) -> dict[str, float]:
    """Return how well the tokenizer of a finished run gives back scans, by the name of each error.

    Raises:
        ConfigError: a run whose generator has no tokenizer.
    """
    generator = load(run_folder)
    if not isinstance(generator, LidarGrit):
        raise ConfigError(f"a run of {type(generator).__name__}", "a generator with a tokenizer", "sample and score it")
    images = open_images(source, generator.sensor, config, reporter)
    return asdict(score_reconstruction(generator.tokenizer, images))


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

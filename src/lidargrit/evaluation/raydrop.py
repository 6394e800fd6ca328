"""Drops of a model on clean scans, and independent drops → distances of their curves from those of true drops."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from lidargrit.core.errors import ConfigError
from lidargrit.data.images import RangeImages
from lidargrit.evaluation.realism import SimulatedScans, distance, drop_independently
from lidargrit.generation.generator import Generator, load
from lidargrit.nn.devices import usable_device
from lidargrit.scans.condition import Observed
from lidargrit.scans.fills import ranges_from_others
from lidargrit.scans.types import MetricResult, RangeImage

RAYDROP_CURVES = (
    "return_rate_per_ring",
    "return_rate_per_range",
    "return_rate_by_incidence",
    "drop_run_lengths",
    "drop_correlation",
)
"""Curves that depend on which rays return, each a Jensen-Shannon distance."""

_TITLES = {
    "simulated": "raydrop of simulated scans",
    "real": "... real scans, decoded",
    "real_triangulated": "... real, triangulated",
}


@dataclass(frozen=True)
class RaydropScore:
    """Jensen-Shannon distances, from 0 (alike) to 1, of one curve between true scans and scans with sampled drops.

    Args:
        scans: kind of the scans to which drops are added: ``simulated``; ``real``, with ranges that a tokenizer
            decodes; or ``real_triangulated``, with ranges that are interpolated from other rays' returns.
        bernoulli: distance between the true drops and independent drops of one probability, on the same clean ranges.
        real_against_real: distance between the two halves of the true scans.
    """

    scans: str
    model: MetricResult
    bernoulli: MetricResult
    real_against_real: MetricResult


def score_raydrop(generator: Generator, scans: str, clean: RangeImage, true: RangeImage) -> list[RaydropScore]:
    """Drop returns of clean scans by a model, and independently of one another, and compare both with the true scans.

    Args:
        scans: kind of the scans; see :class:`RaydropScore`.
        clean: batch of range images in which every surface returns.
        true: measured range images of the same scans, with true drops.
    """
    _check(generator)
    dropped = []
    for first in range(0, len(clean), generator.compute_batch):
        some = clean[first : first + generator.compute_batch]
        seeds = range(first, first + len(some))
        dropped.append(generator.complete(Observed.of_surfaces(some), seeds).to("cpu"))
    by_model = RangeImage.cat(dropped)
    independent = drop_independently(clean, float(true.return_mask.float().mean()))
    half = len(true) // 2
    return [
        RaydropScore(
            scans,
            distance(name, [by_model], _only(true)),
            distance(name, [independent], _only(true)),
            distance(name, [true[:half]], _only(true[half:])),
        )
        for name in RAYDROP_CURVES
    ]


def raydrop_model(word: str, device: str = "") -> Generator:
    """Load a run that drops returns of clean scans, and has a tokenizer to estimate those of real scans.

    Args:
        word: folder of a finished run, or ``pretrained``.
    """
    generator = load(word).to(usable_device(device))
    _check(generator)
    _check_tokenizer(generator)
    return generator


def scores_of_model(generator: Generator, simulated: SimulatedScans, real: RangeImages) -> list[RaydropScore]:
    """Score a model's drops: on simulated scans, whose clean ranges are known, and on real ones, estimated twice.

    Args:
        generator: model of :func:`raydrop_model`.
        simulated: simulated scans of the run's sensor, before and after drops.
        real: real scans of its sensor.
    """
    decoded, true = decoded_surfaces(generator, real)
    pairs = {
        "simulated": (simulated.clean, simulated.measured),
        "real": (decoded, true),
        "real_triangulated": (triangulated_surfaces(true), true),
    }
    return [score for scans, (clean, of) in pairs.items() for score in score_raydrop(generator, scans, clean, of)]


@torch.no_grad()
def decoded_surfaces(generator: Generator, real: RangeImages) -> tuple[RangeImage, RangeImage]:
    """Return scans with a decoded range for every ray, and the original scans.

    A ray that never returns in any of the scans, such as one that ends on the car, has no surface.

    Args:
        real: scans of its sensor.
    """
    _check_tokenizer(generator)
    if not generator.sensor.same_rays(real.sensor):
        raise ConfigError(
            f"a model of {generator.sensor.name!r}", f"one of {real.sensor.name!r}", "name a model of the scans' sensor"
        )
    tokenizer, sensor = generator.get_tokenizer(), generator.sensor
    true = real.batch(range(len(real)))
    ranges = [
        tokenizer.decode(tokenizer.encode(true[index : index + 1].to(generator.device))).range_m
        for index in range(len(true))
    ]
    range_m = torch.cat(ranges).float().cpu().clamp(sensor.range_min_m, sensor.range_max_m)
    return _surfaces(range_m, true), true


def triangulated_surfaces(true: RangeImage) -> RangeImage:
    """Return scans with a range for every ray, interpolated from the returns of other rays.

    A ray that never returns in any of the scans, such as one that ends on the car, has no surface.

    Args:
        true: batch of real scans.
    """
    return _surfaces(ranges_from_others(true, torch.Generator().manual_seed(0)).range_m, true)


def _surfaces(range_m: Tensor, true: RangeImage) -> RangeImage:
    """Return clean scans of these ranges, with no surface where none of the true scans has a return."""
    return RangeImage.masked(range_m, true.return_mask.any(0).expand_as(true.return_mask), true.sensor)


def raydrop_table(scores: Sequence[RaydropScore]) -> str:
    """Return scores as lines for a terminal."""
    lines = []
    for scans in dict.fromkeys(score.scans for score in scores):
        lines.append(f"{_TITLES[scans]:<28}{'model':>10}{'Bernoulli':>11}{'real v real':>13}")
        for score in scores:
            if score.scans == scans:
                values = (
                    f"{score.model.value:>10.4f}{score.bernoulli.value:>11.4f}{score.real_against_real.value:>13.4f}"
                )
                lines.append(f"{score.model.metric:<28}{values}")
    return "\n".join(lines)


def raydrop_json(scores: Sequence[RaydropScore]) -> list[dict[str, Any]]:
    """Return scores with their curves for a file."""
    return [asdict(score) for score in scores]


def _check(generator: Generator) -> None:
    if "surfaces" not in generator.conditions:
        got = f"{generator.public_name()!r}, which drops no returns of clean scans"
        raise ConfigError(got, "a model that does, such as pretrained", "name another model")


def _check_tokenizer(generator: Generator) -> None:
    if "encode" not in generator.capabilities:
        got = f"{generator.public_name()!r}, which has no tokenizer to decode clean ranges by"
        raise ConfigError(got, "a model with one, such as pretrained", "name another model")


def _only(images: RangeImage) -> Iterator[RangeImage]:
    yield images

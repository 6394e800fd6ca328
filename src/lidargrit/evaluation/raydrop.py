"""Simulated streets, or a model that drops returns of clean scans → distances of their curves from real ones."""

from typing import Any

import torch
from torch import Tensor

from lidargrit.core.errors import ConfigError
from lidargrit.core.table import render
from lidargrit.data.datasets.shared.streets import STREETS_VERSION, Streets
from lidargrit.data.images import RangeImages
from lidargrit.data.sources import open_source
from lidargrit.evaluation.evaluate import EvalConfig
from lidargrit.evaluation.protocols import public_name
from lidargrit.evaluation.realism import CurveScore, SimulatedScans, StreetScans, compare, score_curves, tables
from lidargrit.evaluation.street_figures import figures_table
from lidargrit.generation.generator import Generator, load
from lidargrit.scans.condition import Observed
from lidargrit.scans.fills import ranges_from_others
from lidargrit.scans.types import RangeImage

RAYDROP_CURVES = (
    "return_rate_per_ring",
    "return_rate_per_range",
    "return_rate_by_incidence",
    "drop_run_lengths",
    "drop_correlation",
)
"""Curves that depend on which rays return, each a Jensen-Shannon distance."""


def streets_of(samples: str, config: EvalConfig) -> Streets | None:
    """Return the simulated streets that the protocol ``streets`` scores; None for other samples and protocols."""
    if public_name(config.protocol) != "streets" or not samples.startswith("simulated"):
        return None
    source = open_source(samples, config.data.bad_points)
    streets = source.scans() if source.has_points else None
    return streets if isinstance(streets, Streets) else None


def evaluate_streets(
    samples: str, streets: Streets, reference: str, config: EvalConfig, model: str = "", beside: str = ""
) -> tuple[str, dict[str, Any], list[CurveScore]]:
    """Compare simulated streets, and independent drops of their clean scans, with real scans.

    Args:
        model: run that drops returns of clean scans, which is compared too; none if empty.
        beside: source of scans of another real drive, which are compared too; none if empty.

    Returns:
        tables, their plain values, and the curves, which can be plotted.
    """
    drops = raydrop_model(model, config.device) if model else None  # refused before anything is simulated
    source = open_source(reference, config.data.bad_points)
    other = open_source(beside, config.data.bad_points) if beside else None
    scans = StreetScans.of(streets, source, config.sensor, config.data_config())
    real, another = scans.real(), other.images(scans.rays, scans.config) if other else None
    simulated = scans.simulated()
    of_model = scores_of_model(drops, simulated, real) if drops else []
    scores = compare(simulated, real, beside=another)
    figures = scans.figures(other)
    about = {"protocol": "streets", "samples": samples, "reference": reference, "settings": config.facts()}
    about |= {"streets": STREETS_VERSION} | ({"beside": beside} if beside else {})
    found = {"curves": [each.to_json() for each in scores], "raydrop": [each.to_json() for each in of_model]}
    found |= {"figures": {name.replace(" ", "_"): each.to_json() for name, each in figures.items()}}
    return render([*tables([*scores, *of_model]), figures_table(figures)]), {**about, **found}, scores


def score_raydrop(generator: Generator, scans: str, clean: RangeImage, true: RangeImage) -> list[CurveScore]:
    """Drop returns of clean scans by a model, and independently of one another, and compare both with the true scans.

    Args:
        scans: kind of the scans; see :class:`.CurveScore`.
        clean: batch of range images in which every surface returns.
        true: measured range images of the same scans, with true drops.
    """
    _check(generator)
    dropped = generator.stream(range(len(clean)), condition=Observed.of_surfaces(clean))
    images = RangeImage.stack([image.to("cpu") for image in dropped])
    return score_curves(images, clean, true, RAYDROP_CURVES, scans)


def raydrop_model(word: str, device: str = "") -> Generator:
    """Load a run that drops returns of clean scans.

    Args:
        word: folder of a finished run, or ``pretrained``.
    """
    generator = load(word, device=device)
    _check(generator)
    return generator


def scores_of_model(generator: Generator, simulated: SimulatedScans, real: RangeImages) -> list[CurveScore]:
    """Score a model's drops: on simulated scans, whose clean ranges are known, and on real ones.

    The clean ranges of real scans are interpolated, and decoded if the model has a tokenizer.
    """
    generator = generator.for_sensor(real.sensor).to(generator.device)
    true = real.batch(range(len(real)))
    pairs = {"simulated": (simulated.clean, simulated.measured)}
    if "encode" in generator.capabilities:
        pairs["real"] = decoded_surfaces(generator, true), true
    pairs["real_triangulated"] = triangulated_surfaces(true), true
    return [score for scans, (clean, of) in pairs.items() for score in score_raydrop(generator, scans, clean, of)]


@torch.no_grad()
def decoded_surfaces(generator: Generator, true: RangeImage) -> RangeImage:
    """Return scans with a range for every ray, decoded by the tokenizer of their sensor's model.

    A ray that never returns in any of the scans, such as one that ends on the car, has no surface.
    """
    tokenizer, sensor = generator.get_tokenizer(), generator.sensor
    ranges = [
        tokenizer.decode(tokenizer.encode(true[index : index + 1].to(generator.device))).range_m
        for index in range(len(true))
    ]
    range_m = torch.cat(ranges).float().cpu().clamp(sensor.range_min_m, sensor.range_max_m)
    return _surfaces(range_m, true)


def triangulated_surfaces(true: RangeImage) -> RangeImage:
    """Return scans with a range for every ray, interpolated from the returns of other rays.

    A ray that never returns in any of the scans, such as one that ends on the car, has no surface.
    """
    return _surfaces(ranges_from_others(true, torch.Generator().manual_seed(0)).range_m, true)


def _surfaces(range_m: Tensor, true: RangeImage) -> RangeImage:
    """Return clean scans of these ranges, with no surface where none of the true scans has a return."""
    return RangeImage.masked(range_m, true.return_mask.any(0).expand_as(true.return_mask), true.sensor)


def _check(generator: Generator) -> None:
    if "surfaces" not in generator.conditions:
        got = f"{generator.public_name()!r}, which drops no returns of clean scans"
        raise ConfigError(got, "a model that does, such as pretrained", "name another model")

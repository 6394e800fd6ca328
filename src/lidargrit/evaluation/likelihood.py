"""Scans under a model: range images → bits with intervals, maps of bits, and errors of reconstruction."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from lidargrit.core import reporting
from lidargrit.core.determinism import evenly_spaced
from lidargrit.core.errors import DataError, ScanError, counted_scans
from lidargrit.core.files import atomic_path
from lidargrit.core.table import Table, render
from lidargrit.data.images import RangeImages
from lidargrit.data.pasts import Pasts
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.run_folder import locate
from lidargrit.data.sources import RunSource, open_source, overlap
from lidargrit.evaluation.intervals import Estimate
from lidargrit.evaluation.pairs import EvalSet
from lidargrit.evaluation.reconstruction import score_reconstruction
from lidargrit.generation.generator import Generator, load
from lidargrit.scans.bits import ScanBits
from lidargrit.scans.condition import NOTHING
from lidargrit.scans.projection.image import told_share
from lidargrit.scans.sensors import SensorModel

_BATCH = 4
_COMPARED_AT_MOST = 64  # scans: enough to tell systems apart, and seconds where all would take minutes
_COMPARED_STEP_MM = 10  # in which ranges are rounded
_ALL = "all"
_UNITS = {"scan": "a scan", "return": "a return", "pixel": "a pixel"}


@dataclass(frozen=True)
class Likelihood:
    """Bits of all scans of a set, with ranges rounded to one step.

    Args:
        is_whole: whether the bits name the whole scan, or only its tokens.
        parts: bits of each scan, by the name of the part: ``tokens``, ``mask``, ``range``.
        pixels: number of pixels of a scan, which is the same for all.
    """

    step_mm: int
    is_whole: bool
    names: Sequence[str]
    parts: dict[str, list[float]]
    returns: list[int]
    pixels: int

    def estimates(self) -> dict[str, dict[str, Estimate]]:
        """Return the bits a scan, a return and a pixel, by part and then by unit; ``all`` sums a scan's parts up."""
        parts = dict(self.parts)
        if self.is_whole:
            parts[_ALL] = [sum(bits) for bits in zip(*self.parts.values(), strict=True)]
        returns = [float(count) for count in self.returns]
        counts = {"scan": [1.0] * len(returns), "return": returns, "pixel": [float(self.pixels)] * len(returns)}
        return {
            part: {unit: Estimate.of_ratio(bits, count) for unit, count in counts.items()}
            for part, bits in parts.items()
        }

    def as_json(self) -> dict[str, Any]:
        """Return everything as plain numbers and words."""
        bits = {part: {unit: asdict(each) for unit, each in units.items()} for part, units in self.estimates().items()}
        scans = [
            {"name": name, "returns": count, **{part: self.parts[part][index] for part in self.parts}}
            for index, (name, count) in enumerate(zip(self.names, self.returns, strict=True))
        ]
        facts = {"step_mm": self.step_mm, "whole_scan": self.is_whole, "num_scans": len(self.names)}
        return {**facts, "pixels": self.pixels, "bits": bits, "scans": scans}

    def table(self) -> Table:
        """Return the bits by part and by unit."""
        rows = [(part, *(_as_text(units[unit]) for unit in _UNITS)) for part, units in self.estimates().items()]
        returns = f"{sum(self.returns) / len(self.returns):,.0f} returns a scan"
        steps = f"ranges in steps of {self.step_mm} mm"
        notes = [f"{counted_scans(len(self.names))}, {returns}, {steps}; 95 % intervals over scans"]
        if not self.is_whole:
            notes.append("tokens alone: this model has no probabilities of returns and ranges (no pixel decoder)")
        return Table(("bits", *_UNITS.values()), tuple(rows), notes=tuple(notes))


def _as_text(estimate: Estimate) -> str:
    return estimate.as_text(",.0f" if abs(estimate.value) >= 1000 else ",.3f")


def score_likelihood(
    generator: Generator, images: RangeImages, step_mm: int = 10, maps: Path | None = None
) -> Likelihood:
    """Return the bits of all images of a set; every scan is coded by itself, or given its past in a drive.

    Args:
        maps: file to write the bits of every pixel to, float32 (N, H, W) as ``.npy``; none if not given.
    """
    parts: dict[str, list[float]] = {}
    sensor, returns, whole = images.sensor, [], False
    size = (len(images), sensor.height, sensor.width)
    with _maps(maps, size) as pixels, reporting.progress("scans", len(images)) as progress:
        for bits in _bits(generator, images, range(len(images)), step_mm):
            for name, values in bits.per_scan().items():
                parts.setdefault(name, []).extend(values.tolist())
            returns += bits.return_mask.sum((1, 2)).tolist()
            whole = bits.is_whole
            if pixels is not None:
                pixels.write(bits.per_pixel().cpu().numpy().astype("<f4").tobytes())
            progress.advance(len(bits.return_mask))
    return Likelihood(step_mm, whole, images.provenance.names, parts, returns, sensor.height * sensor.width)


def bits_per_return(generator: Generator, scans: EvalSet) -> float | None:
    """Return the bits that the model needs for a return of whole scans; None if it has no such likelihood.

    Args:
        generator: any model; without the capability ``likelihood``, or with tokens alone, it gets None.
        scans: scans of its sensor, of which at most 64 are taken, evenly spaced.
    """
    if "likelihood" not in generator.capabilities:
        return None
    bits, returns = 0.0, 0
    for found in _bits(generator, scans, evenly_spaced(_COMPARED_AT_MOST, len(scans)), _COMPARED_STEP_MM):
        if not found.is_whole:
            return None
        bits += float(found.total().sum())
        returns += int(found.return_mask.sum())
    return bits / returns if returns else None


def _bits(
    generator: Generator, scans: RangeImages | EvalSet, indices: Sequence[int], step_mm: int
) -> Iterator[ScanBits]:
    pasts = _pasts(generator, scans)
    for first in range(0, len(indices), _BATCH):
        some = indices[first : first + _BATCH]
        condition = NOTHING if pasts is None else pasts.of(some)
        yield generator.bits(scans.batch(some), step_mm, condition=condition)


def _pasts(generator: Generator, scans: RangeImages | EvalSet) -> Pasts | None:
    """Return the pasts of scans of drives for a generator that takes them; None for other scans and generators."""
    if generator.past_scans and isinstance(scans, RangeImages):
        with suppress(DataError):  # of scans that are no drives
            return Pasts(scans, generator.past_scans)
    return None


@contextmanager
def _maps(path: Path | None, size: tuple[int, int, int]) -> Iterator[BinaryIO | None]:
    """Yield a file that takes the pixels of one scan after the other, so that memory does not grow with their number.

    An array that is mapped to the file would end the process without a word where the disk is full.
    """
    if path is None:
        yield None
        return
    with atomic_path(path) as unfinished, unfinished.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": size})
        yield file


def measure_source(
    text: str,
    model: str,
    step_mm: int,
    config: DataConfig,
    maps: Path | None = None,
    device: str = "",
    sensor: SensorModel | None = None,
) -> tuple[str, dict[str, Any]]:
    """Measure the scans of a source by a finished run: their bits, and the errors of their reconstructions.

    Args:
        model: finished run; scans are projected with its sensor, in the way of its training.
        maps: file to write the bits of every pixel to; none if not given.
        sensor: sensor of the scans, for a run that takes any; the run's own if not given.

    Returns:
        tables for people, and the same as plain values: bits of a model that has probabilities, errors of one with
        tokens.
    """
    run = RunSource(model, locate(model))
    config = run.as_projected(config)
    generator = load(model, device=device)
    generator = generator if sensor is None else generator.for_sensor(sensor)
    has_tokens = "tokens" in generator.capabilities
    source = open_source(text, config.bad_points)
    images = source.images(generator.sensor, config)
    if source.has_points:
        with suppress(ScanError):  # of a first scan that was left out, and told of
            reporting.message(told_share(images.batch([0])[0], len(source.scans().scan(0))))
    if shared := overlap(run, None, images.provenance):
        reporting.message(
            f"WARNING: {run.text} has learned from some of these scans ({shared}): the figures flatter it"
        )
    tables: list[Table] = []
    values: dict[str, Any] = {"model": model, "source": text, "projection_variant": config.projection_variant}
    if "likelihood" in generator.capabilities or maps is not None or not has_tokens:  # else refused, with what it lacks
        found = score_likelihood(generator, images, step_mm, maps)
        tables, values = [found.table()], {**values, **found.as_json()}
    if has_tokens:
        errors = score_reconstruction(generator.get_tokenizer(), images)
        tables, values = [*tables, errors.table()], {**values, "reconstruction": asdict(errors)}
    return render(tables), values

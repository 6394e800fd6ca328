"""Real scans, simulated scans, and independent drops of one rate → distances between their curves."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch

from lidargrit.core import reporting
from lidargrit.core.determinism import evenly_spaced
from lidargrit.core.errors import ConfigError, DataError, counted_scans
from lidargrit.core.table import Table
from lidargrit.data.datasets.shared.streets import Streets
from lidargrit.data.images import RangeImages
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources.source import Source
from lidargrit.evaluation.metrics import MetricResult, load_metric
from lidargrit.evaluation.street_figures import StreetFigures
from lidargrit.scans.projection import project, unproject
from lidargrit.scans.sensors import SensorModel, load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.simulator import Observation, observe

CURVES = (
    "return_rate_per_ring",
    "return_rate_per_range",
    "return_rate_by_incidence",
    "range_histogram_per_ring",
    "drop_run_lengths",
    "drop_correlation",
    "reflectance_histogram",
    "bev_occupancy",
    "wall_straightness",
    "flying_points",
    "point_cloud_jsd",
)
"""The metrics that are compared: Jensen-Shannon distances, the last a divergence."""

_BATCH = 16


@dataclass(frozen=True, eq=False)
class SimulatedScans:
    """Simulated scans, before and after raydrop.

    Args:
        clean: range images where all surfaces within the sensor's limits return.
        measured: range images as the sensor records them.
    """

    clean: RangeImage
    measured: RangeImage


@dataclass(frozen=True)
class CurveScore:
    """Jensen-Shannon distances, from 0 (alike) to 1, of one curve of true scans from that of other scans.

    Args:
        own: distance of the simulated scans, or of those whose returns a model drops; they are the generated set of it.
        bernoulli: distance of clean scans from which returns are dropped with one constant probability.
        real_against_real: distance between the two halves of the true scans, which shows how much true scans differ.
        beside: distance of scans of another real drive, which no simulator has to beat; None if none is given.
        scans: kind of the scans whose returns a model drops: ``simulated``; ``real``, with ranges that a tokenizer
            decodes; or ``real_triangulated``, with ranges interpolated from other rays' returns. "" for no model.
    """

    own: MetricResult
    bernoulli: MetricResult
    real_against_real: MetricResult
    beside: MetricResult | None = None
    scans: str = ""

    @property
    def ratio(self) -> float:
        """Distance of the simulator or model over that of independent drops: below 1 it is nearer to true scans."""
        return self.own.value / self.bernoulli.value if self.bernoulli.value > 0 else float("nan")

    def to_json(self) -> dict[str, Any]:
        """Return the distances with their curves."""
        whose = {"scans": self.scans, "model": asdict(self.own)} if self.scans else {"simulated": asdict(self.own)}
        rows = {"bernoulli": asdict(self.bernoulli), "real_against_real": asdict(self.real_against_real)}
        another = {"another_real": asdict(self.beside)} if self.beside else {}
        return {**whose, **rows, **another, "ratio": self.ratio}


def compare(
    simulated: SimulatedScans,
    real: RangeImages,
    curves: Sequence[str] = CURVES,
    beside: RangeImages | None = None,
) -> list[CurveScore]:
    """Compare real scans with simulated ones, and with independent drops of one rate, curve by curve.

    Args:
        simulated: scans of the real ones' sensor, as many as wanted.
        real: real scans, at least two, in the order of their recording.
        beside: scans of another real drive, which are compared too.
    """
    _require_two(real)
    if not simulated.clean.sensor.same_rays(real.sensor):
        got, wanted = simulated.clean.sensor.name, real.sensor.name
        raise ConfigError(f"simulated scans of {got!r}", f"the rays of {wanted!r}", "simulate the sensor of the scans")
    return score_curves(simulated.measured, simulated.clean, real, curves, beside=beside)


def score_curves(
    own: RangeImage,
    clean: RangeImage,
    true: RangeImages | RangeImage,
    curves: Sequence[str],
    scans: str = "",
    beside: RangeImages | None = None,
) -> list[CurveScore]:
    """Compare true scans with others, and with independent drops of clean ones, curve by curve.

    Args:
        own: scans with drops.
        clean: batch of range images in which every surface returns.
        true: measured scans; ``reflectance_histogram`` is left out where one has no reflectance.
        scans: kind of the scans that a model drops returns of; see :class:`CurveScore`.
        beside: scans of another real drive, which are compared too.
    """
    half = len(true) // 2
    pixels, returned = 0, 0
    reflects = beside is None or all(batch.reflectance is not None for batch in batches(beside))
    for batch in batches(true):
        pixels, returned = pixels + batch.return_mask.numel(), returned + int(batch.return_mask.sum())
        reflects &= batch.reflectance is not None
    independent = drop_independently(clean, returned / pixels)
    return [
        CurveScore(
            distance(name, batches(own), batches(true)),
            distance(name, batches(independent), batches(true)),
            distance(name, batches(true, 0, half), batches(true, half)),
            distance(name, batches(beside), batches(true)) if beside else None,
            scans,
        )
        for name in curves
        if name != "reflectance_histogram" or reflects
    ]


def _require_two(real: RangeImages) -> None:
    if len(real) < 2:
        raise DataError(
            counted_scans(len(real), "real"), "at least 2: one half is compared with the other", "name more scans"
        )


def drop_independently(clean: RangeImage, return_share: float) -> RangeImage:
    """Drop returns independently of one another (Bernoulli) at one rate, so that a given share of all pixels returns.

    Args:
        clean: a batch where all surfaces return.
        return_share: share of all pixels that return, in [0, 1]; if fewer pixels see a surface, all of these return.
    """
    rng = torch.Generator().manual_seed(0)
    keep = return_share / max(float(clean.return_mask.float().mean()), 1e-9)
    mask = clean.return_mask & (torch.rand(clean.range_m.shape, generator=rng) < keep)
    return RangeImage.masked(clean.range_m, mask, clean.sensor, clean.planes)


@dataclass(frozen=True, eq=False)
class StreetScans:
    """Streets that are simulated as the real scans beside them were recorded.

    Args:
        firing: sensor that fires.
        config: columns and projection of both, and their largest number.
    """

    seeds: Sequence[int]
    firing: SensorModel
    source: Source
    config: DataConfig

    @classmethod
    def of(cls, streets: Streets, source: Source, sensor: str, config: DataConfig) -> "StreetScans":
        """Choose as many streets and real scans as are wanted, and the sensor of both.

        Args:
            streets: streets that are scanned with the sensor of the real scans.
            sensor: name or ``.json`` file of the sensor; the source's own if empty.
            config: columns and projection of both, and their largest number; at most as many real scans as streets.
        """
        seeds = [streets.seeds[index] for index in evenly_spaced(config.max_scans or len(streets), len(streets))]
        if len(seeds) < 2:
            got = f"{len(seeds)} simulated scan"
            raise ConfigError(got, "at least 2", "name more, as simulated:32:test, and no -n 1")
        firing = load_sensor(sensor) if sensor else source.sensor
        if "@" in str(streets.root) and not streets.made_by.same_rays(firing):
            got = f"streets of {streets.made_by.name!r} and scans of {firing.name!r}"
            raise ConfigError(got, "one sensor", "leave @SENSOR out: streets are scanned as the scans were")
        return cls(seeds, firing, source, replace(config, max_scans=len(seeds)))

    @property
    def rays(self) -> SensorModel:
        """Sensor whose rays the images have."""
        return self.config.with_projection(self.firing)

    def real(self) -> RangeImages:
        """Return the real scans, at least two."""
        real = self.source.images(self.rays, self.config)
        _require_two(real)
        return real

    def simulated(self) -> SimulatedScans:
        """Simulate all streets."""
        clean, measured = (RangeImage.stack(list(images)) for images in zip(*self._pairs(self.rays), strict=True))
        return SimulatedScans(clean, measured)

    def figures(self, beside: Source | None) -> dict[str, StreetFigures]:
        """Measure both, and another real drive, in all columns that are fired: noise and outlines need them."""
        fine = self.rays.fine()
        sources = {"real": self.source, **({"another real": beside} if beside else {})}
        simulated = StreetFigures.of(RangeImage.stack([measured]) for _, measured in self._pairs(fine))
        real = {name: StreetFigures.of(batches(of.images(fine, self.config))) for name, of in sources.items()}
        return {"simulated": simulated, **real}

    def _pairs(self, rays: SensorModel) -> Iterator[tuple[RangeImage, RangeImage]]:
        with reporting.progress("simulating", len(self.seeds)) as progress:
            for seed in self.seeds:
                yield simulate_pair(seed, rays, self.firing)
                progress.advance(1)


def simulate_pair(seed: int, rays: SensorModel, firing: SensorModel | None = None) -> tuple[RangeImage, RangeImage]:
    """Simulate one scan and return both of its images: see :func:`pair_of`.

    Args:
        firing: sensor that fires. If it has other columns than ``rays``, all of its points are projected, so that the
            nearest of several may fill a pixel, as in a real scan. If not given, it fires once for each pixel.
    """
    if firing is None or firing.fine().width == rays.fine().width:
        return pair_of(observe(seed, rays, kept_columns_only=True), rays)
    clean, measured = (
        project(unproject(image), rays) for image in pair_of(observe(seed, firing.fine()), firing.fine())
    )
    return clean, measured


def pair_of(seen: Observation, sensor: SensorModel) -> tuple[RangeImage, RangeImage]:
    """Return the image of all surfaces within the sensor's limits, and what the sensor records of it.

    Rays that end on the car itself meet no surface. Where nothing returned, the range has no noise, and the reflectance
    is 0, because too little light came back to measure one.
    """
    range_m = torch.from_numpy(np.where(seen.return_mask, seen.range_m, seen.clean_range_m))
    within = (range_m >= sensor.range_min_m) & (range_m <= sensor.range_max_m) & torch.from_numpy(~seen.blocked)
    reflectance, label = torch.from_numpy(seen.reflectance), torch.from_numpy(seen.label.astype(np.int64))
    planes = {"reflectance": reflectance, "label": label}

    def image(mask: torch.Tensor) -> RangeImage:
        return RangeImage.masked(range_m, mask, sensor, planes)

    return image(within), image(within & torch.from_numpy(seen.return_mask))


def batches(images: RangeImages | RangeImage, first: int = 0, last: int | None = None) -> Iterator[RangeImage]:
    """Yield batches of images from the first to before the last; all of them if neither is given."""
    last = len(images) if last is None else last
    for start in range(first, last, _BATCH):
        end = min(start + _BATCH, last)
        yield images[start:end] if isinstance(images, RangeImage) else images.batch(range(start, end))


def distance(name: str, generated: Iterator[RangeImage], real: Iterator[RangeImage]) -> MetricResult:
    """Return the distance of one curve of generated scans from that of real ones, both given in batches."""
    metric = load_metric(name)()
    for images, is_real in ((generated, False), (real, True)):
        for batch in images:
            metric.update(batch, real=is_real)
    return metric.compute()


_WHOSE = {  # scans of a score → head of the column of ``own``, and of the first column
    "": ("simulated", "distance of real scans from"),
    "simulated": ("model", "raydrop of simulated scans"),
    "real": ("model", "... real scans, decoded"),
    "real_triangulated": ("model", "... real, triangulated"),
}


def tables(scores: Sequence[CurveScore]) -> list[Table]:
    """Return a table for each kind of scans, the simulator's first."""
    found = []
    for scans in dict.fromkeys(score.scans for score in scores):
        of_kind = [score for score in scores if score.scans == scans]
        whose, title = _WHOSE[scans]
        first = of_kind[0]
        another = _counts(first.beside) if first.beside else ""
        rows = [("scans compared", _counts(first.own), "", "", _counts(first.real_against_real), another)]
        for score in of_kind:
            own, bernoulli, real, another = (
                f"{of.value:.4f}" if of else ""
                for of in (score.own, score.bernoulli, score.real_against_real, score.beside)
            )
            rows.append((score.own.metric, own, bernoulli, f"{score.ratio:.2f}", real, another))
        head = (title, whose, "Bernoulli", "ratio", "real v real", "another real")
        found.append(Table(head, tuple(rows)).without_empty("another real"))
    return found


def _counts(result: MetricResult) -> str:
    return f"{result.num_generated} v {result.num_reference}"

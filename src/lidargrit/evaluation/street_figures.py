"""Range images of streets → figures that tell simulated scans from real ones, each with its unit."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Bool, Float64
from torch import Tensor

from lidargrit.core.table import Table
from lidargrit.evaluation.metrics.wall_straightness import (
    distance_from_line,
    row_step,
    run_means,
    unbroken,
    unbroken_runs,
    upright_runs,
)
from lidargrit.scans.classes import CLASSES
from lidargrit.scans.projection import points_of_pixels
from lidargrit.scans.surface_patches import plane_residuals
from lidargrit.scans.types import RangeImage

_COLUMN_RUN = 10  # rows: at 10 m an HDL-64E sees 60 cm of a wall in so many
_JUMP_M = 1.5  # two surfaces, twice a pulse's length apart
_DROPS_AT_MOST = 4  # between two surfaces; more are a hole of its own, such as a window
_LEVEL = 0.15  # slope of ground at most, as rise over run
_GROUND_REACH_M = 50.0
_BELOW_M = 1.0  # sensor above the ground at least
_ROWS: Final = (15 / 64, 32 / 64)  # of an HDL-64E: rows 15 to 31, which see walls, cars and the far road
_GROUPS: Final = tuple(dict.fromkeys(each.group for each in CLASSES.values() if each.group))


@dataclass(frozen=True)
class Figure:
    """One figure of a set of scans.

    Args:
        unit: unit of the value.
        scale: number of such units in one unit of the samples, which are metres or shares.
        reduce: samples of one scan, or of all scans together → the value.
    """

    unit: str
    scale: float
    reduce: Callable[[Float64[np.ndarray, "n"]], float]


def _quantile(share: float) -> Callable[[Float64[np.ndarray, "n"]], float]:
    return lambda samples: float(np.quantile(samples, share))


def _mean(samples: Float64[np.ndarray, "n"]) -> float:
    return float(samples.mean())


def _spread(samples: Float64[np.ndarray, "n"]) -> float:
    return float(np.quantile(samples, 0.9) - np.quantile(samples, 0.1))


FIGURES: Final[dict[str, Figure]] = {
    "noise along a row, walls": Figure("cm", 100.0, _quantile(0.25)),
    "10 rows of a column, walls": Figure("cm", 100.0, _quantile(0.25)),
    "depth jumps with a drop": Figure("%", 100.0, _mean),
    "returns beyond 60 m": Figure("%", 100.0, _mean),
    "returns beyond 80 m": Figure("%", 100.0, _mean),
    "returns, rows 15 to 31 of 64": Figure("%", 100.0, _mean),
    "height of level ground, 10 to 90 %": Figure("m", 1.0, _spread),
    **{f"{group}, share of returns": Figure("%", 100.0, _mean) for group in _GROUPS},
    **{f"{group}, median range": Figure("m", 1.0, _quantile(0.5)) for group in _GROUPS},
}
"""The figures by name; noise and columns are lower quartiles, so that what is no flat wall does not count."""
OFFSETS: Final = "offsets of rows, spread"
ALIKE: Final = "offsets of rows, correlation"


@dataclass(frozen=True, eq=False)
class StreetFigures:
    """Figures of a set of scans.

    Args:
        pooled: value of each figure over the samples of all scans together; those without a sample are left out.
        over_scans: median over scans of each figure.
        offset_m: offset of each row, the median over scans, in metres (:func:`.plane_residuals`); NaN if unknown.
        num_scans: number of scans.
    """

    pooled: dict[str, float]
    over_scans: dict[str, float]
    offset_m: Float64[np.ndarray, "H"]
    num_scans: int

    @classmethod
    def of(cls, images: Iterable[RangeImage]) -> "StreetFigures":
        """Measure scans, one by one.

        Args:
            images: batches of range images of one sensor; noise and drops between surfaces depend on its columns.
        """
        gathered = _Gathered()
        for batch in images:
            for index in range(len(batch)):
                gathered.add(batch[index : index + 1])
        return gathered.figures()

    def correlation(self, other: "StreetFigures") -> float:
        """Return the correlation of the rows' offsets in two sets; NaN if fewer than two rows are known in both."""
        known = ~(np.isnan(self.offset_m) | np.isnan(other.offset_m))
        if known.sum() < 2:
            return float("nan")
        return float(np.corrcoef(self.offset_m[known], other.offset_m[known])[0, 1])

    def to_json(self) -> dict[str, Any]:
        """Return the values in the units of :data:`FIGURES`, and the offsets in metres."""
        offset_m = [None if np.isnan(each) else float(each) for each in self.offset_m]
        facts = {"scans": self.num_scans, "row_offset_m": offset_m}
        return {**facts, "pooled": self.pooled, "over_scans": self.over_scans}


@dataclass
class _Gathered:
    samples: dict[str, list[Float64[np.ndarray, "_"]]] = field(default_factory=dict)
    offsets_m: list[Float64[np.ndarray, "H"]] = field(default_factory=list)

    def add(self, image: RangeImage) -> None:
        for name, values in {**_surfaces(image), **_returns(image), **_classes(image)}.items():
            self.samples.setdefault(name, []).append(values.double().numpy())
        self.offsets_m.append(plane_residuals(image[0]))

    def figures(self) -> StreetFigures:
        pooled, over_scans = {}, {}
        for name, figure in FIGURES.items():
            if scans := [values for values in self.samples.get(name, []) if len(values)]:
                pooled[name] = figure.scale * figure.reduce(np.concatenate(scans))
                over_scans[name] = figure.scale * float(np.median([figure.reduce(values) for values in scans]))
        offset_m = np.array(self.offsets_m)
        known, found_m = ~np.isnan(offset_m).all(axis=0), np.full(offset_m.shape[1], np.nan)
        found_m[known] = np.nanmedian(offset_m[:, known], axis=0)
        return StreetFigures(pooled, over_scans, found_m, len(self.offsets_m))


def _surfaces(image: RangeImage) -> dict[str, Tensor]:
    """Return the samples that tell of walls and of the ground."""
    points_xyz_m = points_of_pixels(image).double()
    walls = unbroken_runs(image) & upright_runs(points_xyz_m, image.return_mask)
    return {
        "noise along a row, walls": distance_from_line(points_xyz_m[..., 0], points_xyz_m[..., 1])[walls],
        "10 rows of a column, walls": column_distances_m(image),
        "height of level ground, 10 to 90 %": ground_heights_m(image),
    }


def _returns(image: RangeImage) -> dict[str, Tensor]:
    range_m = image.range_m[image.return_mask]
    first, last = (round(share * image.sensor.height) for share in _ROWS)
    return {
        "depth jumps with a drop": jumps_with_a_drop(image),
        "returns beyond 60 m": range_m > 60,
        "returns beyond 80 m": range_m > 80,
        "returns, rows 15 to 31 of 64": image.return_mask[:, first:last].flatten(),
    }


def _classes(image: RangeImage) -> dict[str, Tensor]:
    """Return the samples that tell which class lies where; none for scans without labels."""
    label = image.label
    if label is None or not label.any():
        return {}
    label, range_m = label[image.return_mask], image.range_m[image.return_mask]
    found = {}
    for group in _GROUPS:
        of_group = torch.isin(label, torch.tensor([number for number, each in CLASSES.items() if each.group == group]))
        found |= {f"{group}, share of returns": of_group, f"{group}, median range": range_m[of_group]}
    return found


def column_distances_m(image: RangeImage) -> Tensor:
    """Return the root mean square distance from a straight line of 10 neighbouring returns of a column, on walls.

    Ranges of neighbours agree within a tenth, and the ends of the run are farther apart in height than twice their
    difference in horizontal distance. The line goes through horizontal distances over heights, so a leaning wall or
    sensor does not matter. A constant offset of each laser shows here, and not along a row.

    Returns:
        metres, one value a run.
    """
    if image.sensor.height < _COLUMN_RUN:
        return torch.zeros(0)
    range_m = torch.where(image.return_mask, image.range_m, torch.nan)
    points_xyz_m = points_of_pixels(image).double()
    # Columns become rows, which are circular: what begins in the last rows is left out.
    range_m, distance_m, height_m = (
        each.transpose(-1, -2) for each in (range_m, points_xyz_m[..., :2].norm(dim=-1), points_xyz_m[..., 2])
    )
    last = _COLUMN_RUN - 1
    across_m, up_m = ((each[..., :-last] - each[..., last:]).abs() for each in (distance_m, height_m))
    runs = unbroken(range_m, _COLUMN_RUN)[..., :-last] & (up_m > 2 * across_m)
    return distance_from_line(distance_m, height_m, _COLUMN_RUN)[..., :-last][runs]


def jumps_with_a_drop(image: RangeImage) -> Bool[Tensor, " jumps"]:
    """Return for each depth jump whether a pixel without a return lies between its surfaces.

    A jump is two returns of a circular row that follow one another, with at most four pixels between, whose ranges
    differ by more than 1.5 m.
    """
    column = image.return_mask.nonzero()[:, -1]
    range_m, width = image.range_m[image.return_mask], image.sensor.width
    returns = image.return_mask.flatten(0, -2).sum(dim=-1)
    returns = returns[returns > 0]
    last = returns.cumsum(0) - 1
    following = torch.arange(1, len(column) + 1)
    following[last] = last - returns + 1  # the last return of a row meets its first
    between = (column[following] - column - 1) % width
    jump = (range_m[following] - range_m).abs() > _JUMP_M
    return between[jump & (between <= _DROPS_AT_MOST)] > 0


def ground_heights_m(image: RangeImage) -> Tensor:
    """Return the heights of level ground within 50 m, in the sensor's frame, in metres.

    The mean of 8 neighbouring returns of a row is on level ground if it lies at least 1 m below the sensor, and if it
    differs from the mean in the same columns one row of 32 above (two rows of 64) by less than 15 % of their
    difference in horizontal distance.
    """
    points_xyz_m = points_of_pixels(image).double()
    distance_m, height_m = run_means(points_xyz_m, image.return_mask)
    step = row_step(image.sensor.height)
    rise_m, run_m = ((each[:, :-step] - each[:, step:]).abs() for each in (height_m, distance_m))
    near = (height_m < -_BELOW_M) & (distance_m < _GROUND_REACH_M)
    return height_m[:, step:][(rise_m < _LEVEL * run_m) & near[:, step:]]


def figures_table(sets: dict[str, StreetFigures]) -> Table:
    """Return the figures of several sets side by side: of all scans together, and the median over scans behind it.

    Args:
        sets: figures by the head of their column; offsets of rows are correlated with those of ``real``.
    """
    real = sets["real"]
    rows = [("scans", *(str(each.num_scans) for each in sets.values()))]
    for name, figure in FIGURES.items():
        if any(name in each.pooled for each in sets.values()):
            rows.append((f"{name} [{figure.unit}]", *(_cell(each, name) for each in sets.values())))
    spread_m = [
        float(np.nanstd(each.offset_m)) if (~np.isnan(each.offset_m)).any() else np.nan for each in sets.values()
    ]
    rows.append((f"{OFFSETS} [cm]", *(_number(100 * each) for each in spread_m)))
    rows.append((ALIKE, *("" if each is real else _number(each.correlation(real)) for each in sets.values())))
    return Table(("all scans (median over scans)", *sets), tuple(rows))


def _cell(figures: StreetFigures, name: str) -> str:
    if name not in figures.pooled:
        return ""
    return f"{_number(figures.pooled[name])} ({_number(figures.over_scans[name])})"


def _number(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"

"""Classical methods to fill a scan in, without a network: observed pixels of one scan → all its pixels."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int, Int64
from scipy.ndimage import distance_transform_edt, maximum_filter1d
from scipy.spatial import Delaunay, QhullError
from torch import Tensor

from lidargrit.core.errors import ScanError
from lidargrit.scans.condition import Observed
from lidargrit.scans.sensors import SensorModel, continuous_azimuths_rad
from lidargrit.scans.types import RangeImage

EDGE = 0.8  # of ln(1 + range in metres): two observed returns further apart lie on two surfaces
_JITTER_RAD = 1e-6  # a twentieth of a millimetre at 50 m
_BLOCKS = (1, 2, 4)  # rows and columns of what is left out at once, where ranges are interpolated from other rays
_ROWS_NEAR, _COLUMNS_NEAR = 9, 17  # window in which a return helps to fill an unknown pixel in; farther are others


@dataclass(frozen=True)
class SeenScan:
    """The observed pixels of one scan, with the angles of its rays.

    Args:
        range_m: observed ranges in metres, 0 elsewhere.
        returned: True where a return was observed.
        observed: True where it was observed whether there is a return.
        elevation_rad: mean elevation of each row.
        azimuth_rad: azimuth of each column, falling from +pi to -pi.
    """

    range_m: Float64[np.ndarray, "H W"]
    returned: Bool[np.ndarray, "H W"]
    observed: Bool[np.ndarray, "H W"]
    elevation_rad: Float64[np.ndarray, " H"]
    azimuth_rad: Float64[np.ndarray, " W"]

    @classmethod
    def of(cls, condition: Observed, index: int) -> "SeenScan":
        """Return the observed pixels of one scan of a condition."""
        observed = condition.return_observed[index]
        returned = condition.return_mask[index] & observed
        range_m = torch.where(returned, condition.range_m[index], 0.0).double()
        return cls(range_m.cpu().numpy(), returned.cpu().numpy(), observed.cpu().numpy(), *_angles(condition.sensor))

    def nearest(self, wanted: Bool[np.ndarray, "H W"]) -> tuple[Int64[np.ndarray, "H W"], Int64[np.ndarray, "H W"]]:
        """Return for every pixel row and column of the nearest wanted one by angle, as if rows were equally spaced; of
        itself if none is wanted."""
        return _nearest(wanted, self.elevation_rad)

    @cached_property
    def nearest_return(self) -> tuple[Int64[np.ndarray, "H W"], Int64[np.ndarray, "H W"]]:
        """Row and column of the nearest observed return of every pixel."""
        return self.nearest(self.returned)

    @cached_property
    def triangles(self) -> "Triangles":
        """Triangulation of the observed returns."""
        return triangulate(self)

    @property
    def nearest_range_m(self) -> Float64[np.ndarray, "H W"]:
        """Range of the nearest observed return of every pixel."""
        return self.range_m[self.nearest_return]


def along_rows(
    range_m: Float64[np.ndarray, "H W"], azimuth_rad: Float64[np.ndarray, " W"], at_most_rad: float
) -> Float64[np.ndarray, "H W"]:
    """Interpolate 1 / range along rows between returns of one surface that are near enough to each other; else 0."""
    width = range_m.shape[1]
    thrice = np.tile(range_m, (1, 3)), _thrice(azimuth_rad)
    found, span = (part[:, width : 2 * width] for part in _between(*thrice, across=False))
    return np.where((span <= at_most_rad) & np.isfinite(found), found, 0)


def linear(seen: SeenScan) -> Float64[np.ndarray, "H W"]:
    """Interpolate 1 / range along the row or the column, whichever has the nearer pair of observed returns.

    Where the two lie on different surfaces, the range is that of the one nearer by angle; without a pair it is that of
    the nearest return.
    """
    by_row, row_span = _between(np.tile(seen.range_m, (1, 3)), _thrice(seen.azimuth_rad))
    width = len(seen.azimuth_rad)
    by_row, row_span = by_row[:, width : 2 * width], row_span[:, width : 2 * width]
    by_column, column_span = (part.T for part in _between(seen.range_m.T, seen.elevation_rad))
    found = np.where(row_span < column_span, by_row, by_column)
    return np.where(np.isfinite(found), found, seen.nearest_range_m)


@dataclass(frozen=True)
class Triangles:
    """Ranges from a Delaunay triangulation of the observed returns, for every pixel.

    Args:
        range_m: inverse of the linearly interpolated 1 / range, in metres; the nearest return where a triangle spans an
            edge, and outside of all triangles.
        corners_m: ranges of the three corners in metres, the corner of the largest weight first; the filled range where
            there is no triangle.
        weights: barycentric weights of the corners; 1, 0 and 0 where there is no triangle.
        corner_pixels: indices of the three corners among all pixels, row by row; the nearest return three times where
            there is no triangle, and where it spans an edge.
    """

    range_m: Float64[np.ndarray, "H W"]
    corners_m: Float64[np.ndarray, "3 H W"]
    weights: Float64[np.ndarray, "3 H W"]
    corner_pixels: Int64[np.ndarray, "3 H W"]

    @classmethod
    def none(cls, seen: SeenScan, range_m: Float64[np.ndarray, "H W"]) -> "Triangles":
        """Return the values for pixels without a triangle, from ranges that were filled in another way."""
        weights = np.zeros((3, *range_m.shape))
        weights[0] = 1
        nearest_pixel = np.ravel_multi_index(seen.nearest_return, range_m.shape)
        return cls(range_m.copy(), np.stack([range_m] * 3), weights, np.stack([nearest_pixel] * 3))

    def weighed(self, pixels: Float32[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
        """Return for every pixel the weighted mean of a quantity of the returns at the corners."""
        return (self.weights * pixels.ravel()[self.corner_pixels]).sum(0).astype(np.float32)


def triangulate(seen: SeenScan) -> Triangles:
    """Triangulate the observed returns by the angles of their rays, in which 1 / range of a plane is nearly linear."""
    width = len(seen.azimuth_rad)
    near = maximum_filter1d(maximum_filter1d(~seen.observed, _ROWS_NEAR, 0), _COLUMNS_NEAR, 1, mode="wrap")
    helpful = seen.returned & near
    # The circle closes if as many columns as the widest gap are copied on either side.
    beside = min(width, _widest_gap(np.asarray(helpful.any(0))) + _COLUMNS_NEAR)
    columns = np.arange(-beside, width + beside)
    rows, at = np.nonzero(helpful[:, columns % width])
    azimuth_rad = seen.azimuth_rad[columns % width] - 2 * np.pi * (columns // width)
    corners = np.stack((seen.elevation_rad[rows], azimuth_rad[at]), axis=1)
    pixels = rows * width + columns[at] % width
    range_m = seen.range_m.ravel()[pixels]
    try:
        # The corners of a grid's cell lie on one circle, a tie that Qhull breaks slowly; moved a little, they do not.
        tiling = Delaunay(corners + np.random.default_rng(0).normal(scale=_JITTER_RAD, size=corners.shape))
    except (QhullError, ValueError):  # too few returns, or all on one line
        return Triangles.none(seen, linear(seen))
    missing = np.nonzero(~seen.observed)
    points = np.stack((seen.elevation_rad[missing[0]], seen.azimuth_rad[missing[1]]), axis=1)
    triangle = tiling.find_simplex(points)
    transform = tiling.transform[triangle]
    first_two = np.einsum("nij,nj->ni", transform[:, :2], points - transform[:, 2])
    weights = np.concatenate((first_two, 1 - first_two.sum(1, keepdims=True)), axis=1)
    of_corners = tiling.simplices[triangle]
    of_corners_m = range_m[of_corners]
    inside = (triangle >= 0) & np.isfinite(weights).all(1)  # triangles without an area have no weights
    log_m = np.log1p(of_corners_m)
    with np.errstate(invalid="ignore", divide="ignore"):
        filled_m = 1 / (weights / of_corners_m).sum(1)
        one_surface = inside & (np.ptp(log_m, axis=1) <= EDGE) & (filled_m > 0)
    found = Triangles.none(seen, seen.nearest_range_m)
    found.range_m[_part(missing, one_surface)] = filled_m[one_surface]
    order = np.argsort(-weights, axis=1)
    chosen = (slice(None), *_part(missing, inside))
    found.corners_m[chosen] = np.take_along_axis(of_corners_m, order, axis=1)[inside].T
    found.weights[chosen] = np.take_along_axis(weights, order, axis=1)[inside].T
    chosen = (slice(None), *_part(missing, one_surface))
    found.corner_pixels[chosen] = pixels[np.take_along_axis(of_corners, order, axis=1)[one_surface]].T
    return found


def of_nearest(seen: SeenScan, pixels: Float32[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
    """Return for every pixel a quantity of the nearest observed return."""
    return pixels[seen.nearest_return]


def of_triangle(seen: SeenScan, pixels: Float32[np.ndarray, "H W"]) -> Float32[np.ndarray, "H W"]:
    """Interpolate a quantity of the observed returns in their triangulation, within surfaces."""
    return seen.triangles.weighed(pixels)


class Fill(NamedTuple):
    """A classical method.

    Args:
        range_m: observed pixels → range of every pixel, in metres.
    """

    range_m: Callable[[SeenScan], Float64[np.ndarray, "H W"]]
    reflectance: Callable[[SeenScan, Float32[np.ndarray, "H W"]], Float32[np.ndarray, "H W"]]


FILLS: dict[str, Fill] = {
    "nearest": Fill(lambda seen: seen.nearest_range_m, of_nearest),
    "linear": Fill(linear, of_nearest),
    "triangulation": Fill(lambda seen: seen.triangles.range_m, of_triangle),
}
"""Classical methods by the name that a user types."""


def fill_lacking(completed: RangeImage, condition: Observed) -> RangeImage:
    """Return completed scans with the reflectance and the labels that their observed parts have and they lack.

    Reflectance is that of :data:`FILLS` ``["triangulation"]``, 0 in scans none of whose observed pixels returned, and
    stays unknown where no pixel tells of a return, as for the surfaces of clean scans. A label is that of the nearest
    observed return.

    Args:
        completed: completed scans, on any device.
    """
    tells = condition.reflectance is not None and bool(condition.return_observed.any())
    lacks_reflectance = tells and completed.reflectance is None
    lacks_labels = condition.label is not None and completed.label is None
    if not (lacks_reflectance or lacks_labels):
        return completed
    scans = [SeenScan.of(condition, index) for index in range(len(condition))]
    range_m, planes = completed.range_m, dict(completed.planes)
    if lacks_reflectance:
        found = [_reflectance_of(condition, index, seen, of_triangle) for index, seen in enumerate(scans)]
        planes["reflectance"] = torch.stack(found).to(range_m.device)
    if lacks_labels:
        found = [_label_of(condition, index, seen) for index, seen in enumerate(scans)]
        planes["label"] = torch.stack(found).to(range_m.device)
    return RangeImage.masked(range_m, completed.return_mask, completed.sensor, planes)


def fill(method: str, condition: Observed) -> RangeImage:
    """Fill ranges and reflectance in by a classical method, returns from the nearest observed pixel, and labels from
    the nearest observed return.

    Args:
        method: name of the method, one of :data:`FILLS`.
        condition: observed pixels of a batch of scans; a scan without any observed return is filled without returns.
    """
    sensor = condition.sensor
    ranges, masks, reflectances, labels = [], [], [], []
    for index in range(len(condition)):
        seen = SeenScan.of(condition, index)
        mask = seen.returned[seen.nearest(seen.observed)]
        some, by = bool(seen.returned.any()), FILLS[method]
        range_m = np.clip(by.range_m(seen), sensor.range_min_m, sensor.range_max_m) if some else seen.range_m
        masks.append(torch.from_numpy(mask))
        ranges.append(torch.from_numpy(range_m).float())
        if condition.reflectance is not None:
            reflectances.append(_reflectance_of(condition, index, seen, by.reflectance))
        if condition.label is not None:
            labels.append(_label_of(condition, index, seen))
    planes = {name: torch.stack(found) for name, found in (("reflectance", reflectances), ("label", labels)) if found}
    filled = RangeImage.masked(torch.stack(ranges), torch.stack(masks), sensor, planes)
    return condition.to("cpu").put_into(filled)


def _reflectance_of(
    condition: Observed,
    index: int,
    seen: SeenScan,
    method: Callable[[SeenScan, Float32[np.ndarray, "H W"]], Float32[np.ndarray, "H W"]],
) -> Float[Tensor, "H W"]:
    """Return the reflectance of every pixel of a scan by a method; 0 where no return was observed."""
    assert condition.reflectance is not None
    pixels = condition.reflectance[index].cpu().numpy()
    return torch.from_numpy(method(seen, pixels) if seen.returned.any() else np.zeros_like(pixels)).clamp(0, 1)


def _label_of(condition: Observed, index: int, seen: SeenScan) -> Int[Tensor, "H W"]:
    """Return for every pixel of a scan the label of the nearest observed return; 0 where there is none."""
    assert condition.label is not None
    label = condition.label[index].cpu()
    rows, columns = (torch.from_numpy(part) for part in seen.nearest_return)
    return label[rows, columns] if seen.returned.any() else torch.zeros_like(label)


def fill_from_nearest(images: RangeImage, observed: Bool[Tensor, "B H W"]) -> RangeImage:
    """Return scans in which every unobserved pixel is a copy of the nearest observed one by angle, as if rows were
    equally spaced.

    Args:
        images: batch of range images; what was observed without a return has a range of 0.
        observed: True for pixels that were observed.
    """
    elevation_rad, _ = _angles(images.sensor)
    parts = [images.range_m] if images.reflectance is None else [images.range_m, images.reflectance]
    filled = []
    for pixels, mask in zip(torch.stack(parts, 1).cpu(), observed.cpu(), strict=True):
        rows, columns = (torch.from_numpy(part) for part in _nearest(mask.numpy(), elevation_rad))
        filled.append(pixels[:, rows, columns] if bool(mask.any()) else torch.zeros_like(pixels))
    range_m, *reflectance = torch.stack(filled).to(images.range_m.device).unbind(1)
    planes = {"reflectance": reflectance[0]} if reflectance else {}
    return RangeImage(range_m, range_m > 0, images.sensor, planes)


def ranges_from_others(images: RangeImage, rng: torch.Generator) -> RangeImage:
    """Return for every ray a range that is interpolated from other rays' returns, whether it returned itself or not.

    Blocks of pixels are divided at random into two halves, and each half is triangulated from the returns of the other.
    So returned and dropped rays cannot be distinguished by the noise of a measured range.
    """
    sensor, device = images.sensor, images.range_m.device
    height, width = sensor.height, sensor.width
    found = []
    for index in range(len(images)):
        side = _BLOCKS[int(torch.randint(len(_BLOCKS), (), generator=rng, device=rng.device))]
        rows, columns = -(-height // side), -(-width // side)
        coins = torch.rand((rows, columns), generator=rng, device=rng.device) < 0.5
        half = coins.repeat_interleave(side, 0).repeat_interleave(side, 1)[:height, :width].to(device)
        range_m = torch.zeros(height, width, dtype=torch.float64)
        for given in (half, ~half):
            seen = SeenScan.of(Observed.of_pixels(images[index : index + 1], given[None]), 0)
            if not seen.returned.any():
                raise ScanError("a scan with hardly any return", "returns on every side", "leave the scan out")
            range_m = torch.where(given.cpu(), range_m, torch.from_numpy(seen.triangles.range_m))
        found.append(range_m.float().clamp(sensor.range_min_m, sensor.range_max_m))
    range_m = torch.stack(found).to(device)
    return RangeImage(range_m, torch.ones_like(images.return_mask), sensor)


def _nearest(
    wanted: Bool[np.ndarray, "H W"], elevation_rad: Float64[np.ndarray, " H"]
) -> tuple[Int64[np.ndarray, "H W"], Int64[np.ndarray, "H W"]]:
    height, width = wanted.shape
    if not wanted.any():
        rows, columns = np.indices((height, width))
        return rows, columns
    thrice = np.tile(~wanted, (1, 3))  # so that the circle closes
    steps = (np.abs(np.diff(elevation_rad)).mean() if height > 1 else 1.0, 2 * np.pi / width)
    nearest = np.empty((2, height, 3 * width), dtype=np.int32)
    distance_transform_edt(thrice, steps, return_distances=False, return_indices=True, indices=nearest)
    rows, columns = nearest[:, :, width : 2 * width].astype(np.int64)
    return rows, columns % width


def _angles(sensor: SensorModel) -> tuple[Float64[np.ndarray, " H"], Float64[np.ndarray, " W"]]:
    elevation_rad = sensor.elevation_rad.double().mean(1).cpu().numpy()
    return elevation_rad, continuous_azimuths_rad(sensor.azimuth_rad).mean(0).cpu().numpy()


def _thrice(azimuth_rad: Float64[np.ndarray, " W"]) -> Float64[np.ndarray, " W*3"]:
    return np.concatenate([azimuth_rad - turn * 2 * np.pi for turn in (-1, 0, 1)])


def _part(pixels: tuple[np.ndarray, ...], chosen: Bool[np.ndarray, " n"]) -> tuple[np.ndarray, ...]:
    return tuple(axis[chosen] for axis in pixels)


def _widest_gap(some: Bool[np.ndarray, " W"]) -> int:
    """Return the length of the longest run of empty columns around the circle."""
    columns = np.nonzero(some)[0]
    if not len(columns):
        return len(some)
    return int(np.diff(np.append(columns, columns[0] + len(some))).max()) - 1


def _between(
    range_m: Float64[np.ndarray, "lines n"], angle_rad: Float64[np.ndarray, " n"], across: bool = True
) -> tuple[Float64[np.ndarray, "lines n"], Float64[np.ndarray, "lines n"]]:
    """Interpolate between the last and the next return along lines; return that and their angular distance.

    Args:
        range_m: ranges along each line, 0 where none was observed.
        angle_rad: angle of each pixel of a line, falling or rising.
        across: whether the nearer of two returns on different surfaces counts, or neither.
    """
    index = np.arange(range_m.shape[1])
    before = np.maximum.accumulate(np.where(range_m > 0, index, -1), axis=1)
    after = np.minimum.accumulate(np.where(range_m > 0, index, len(index))[:, ::-1], axis=1)[:, ::-1]
    both = (before >= 0) & (after < len(index))
    before, after = np.where(both, before, 0), np.where(both, after, 0)
    first_m, second_m = (np.take_along_axis(range_m, at, axis=1) for at in (before, after))
    to_first, to_second = np.abs(angle_rad - angle_rad[before]), np.abs(angle_rad - angle_rad[after])
    span = to_first + to_second
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(span > 0, to_first / span, 0.0)
        one_surface = np.abs(np.log1p(first_m) - np.log1p(second_m)) <= EDGE
        smooth = 1 / ((1 - share) / first_m + share / second_m)
    found = np.where(one_surface, smooth, np.where(share <= 0.5, first_m, second_m) if across else np.inf)
    return np.where(both, found, np.inf), np.where(both, span, np.inf)

"""The past of a drive → what it tells of each ray of the present image: its returns, moved by the sensor's own motion.

All numbers are sums, products, quotients and roots in 64 bits, one after the other, and ties are in a fixed order. So
every machine finds the same bits, and a drive that one compressed by them can be decompressed on another.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Float64, Int64
from torch import Tensor

from lidargrit.scans.past import Past
from lidargrit.scans.sensors import SensorModel, continuous_azimuths_rad

_BESIDE = 2  # fine columns to the neighbours of a plane: nearer ones are less far apart than ranges are wrong
_SAME_SURFACE = 0.15  # of a range: neighbours that differ by more are of another surface
_ON_SURFACE_M, _ON_SURFACE = 0.05, 0.02  # metres, and share of the range, by which returns on one surface differ
_COS_AT_LEAST = 0.03  # of incidence: flatter planes are not followed
_CORRECTION_AT_MOST = 0.1  # of a range
_LONE_ROW_RAD = math.radians(1)  # height of the row of a sensor with only one
_TERMS = 18  # of the series of sine and cosine: beyond, they are below the last bit
_ROUGHLY = 1.1  # times the slack, which errors of 32 bits do not use up
_SLACK = 1.01  # of a fine column: which column is nearest is decided later


class WarpedReturns(NamedTuple):
    """Returns of past scans on rays of the present image, one a ray; all numbers are 0 where there is none.

    Args:
        range_m: range along the ray, in metres.
        age_s: time since the return was measured, in seconds.
        cos_incidence: cosine between the ray and the normal of the return's plane; 0 where no plane was found.
        offset_rad: angle from the ray to the return.
    """

    range_m: Float64[Tensor, "*B H W"]
    age_s: Float64[Tensor, "*B H W"]
    cos_incidence: Float64[Tensor, "*B H W"]
    offset_rad: Float64[Tensor, "*B H W"]

    @property
    def mask(self) -> Bool[Tensor, "*B H W"]:
        """True on rays with a return."""
        return self.range_m > 0


class WarpedSurface(NamedTuple):
    """The mean of the returns on each ray that lie on the surface of the nearest; all are 0 where there is none.

    Args:
        range_m: mean range along the ray, in metres.
        spread_m: mean distance of the returns from their mean, in metres.
        returns: number of the returns.
    """

    range_m: Float64[Tensor, "B H W"]
    spread_m: Float64[Tensor, "B H W"]
    returns: Int64[Tensor, "B H W"]


@dataclass(frozen=True, eq=False)
class WarpedPast:
    """What the past tells of each ray of the present image.

    Args:
        copied_m: ranges of the latest scan as it was, in metres; 0 where nothing returned.
        last: nearest return of the latest scan within one fine column of the ray.
        nearest: nearest return of all scans within half a fine column.
        aligned: return of all scans within one fine column that is nearest to the ray in angle.
        surface: mean of the returns within one fine column about the nearest one; where none is within half a column,
            about the aligned one.
        scans: number of scans with a return within half a fine column.
    """

    copied_m: Float64[Tensor, "B H W"]
    last: WarpedReturns
    nearest: WarpedReturns
    aligned: WarpedReturns
    surface: WarpedSurface
    scans: Int64[Tensor, "B H W"]


def warp(past: Past) -> WarpedPast:
    """Move the returns of past scans into the present frame and put each on the ray that it meets.

    A return lies on the ray of its own pixel by the sensor's table. It goes to the row nearest in elevation and to the
    column nearest in azimuth. Its new range is that at which the ray meets the plane through the return and its
    neighbours, or the return's own distance where there is no such plane.
    """
    rays = _rays_of(past.sensor, past.range_m.device)
    size = past.sensor.height, past.sensor.width
    last, nearest, aligned = list[WarpedReturns](), list[WarpedReturns](), list[WarpedReturns]()
    surface, scans = list[WarpedSurface](), list[Tensor]()
    for images_m, transforms, ages_s in zip(past.range_m, past.transforms, past.ages_s, strict=True):
        latest_first = [*zip(images_m, transforms, ages_s, strict=True)][::-1]
        each = [_on_rays(image_m, matrix, age_s, rays) for image_m, matrix, age_s in latest_first]
        every = _OnRays(*(torch.cat(parts) for parts in zip(*each, strict=True)))
        last.append(each[0].least(each[0].range_m, size))
        nearest.append(every.least(torch.where(every.is_close, every.range_m, torch.inf), size))
        aligned.append(every.least(every.offset_rad, size))
        about_m = torch.where(nearest[-1].mask, nearest[-1].range_m, aligned[-1].range_m)
        surface.append(every.surface(about_m))
        scans.append(torch.stack([one.close_pixels(size) for one in each]).sum(0))
    copied_m = past.range_m[:, -1, :, :: past.sensor.column_stride].double()
    layers = _stacked(last), _stacked(nearest), _stacked(aligned)
    means = WarpedSurface(*map(torch.stack, zip(*surface, strict=True)))
    return WarpedPast(copied_m, *layers, means, torch.stack(scans))


def _stacked(of_scans: list[WarpedReturns]) -> WarpedReturns:
    return WarpedReturns(*map(torch.stack, zip(*of_scans, strict=True)))


class _Rays(NamedTuple):
    """Rays of a sensor in 64 bits.

    Args:
        fine: directions of all pixels of an image with all fine columns: x, y and z.
        fine32: directions of the same pixels in 32 bits.
        kept: directions of the pixels of an image.
        edge_sine: sines of the elevations at which rows end, rising.
        first_rad: azimuth of the first pixel of each row.
        limits_m: shortest and longest range.
    """

    fine: Float64[Tensor, "3 H fine_W"]
    fine32: Float[Tensor, "3 H fine_W"]
    kept: Float64[Tensor, "3 H W"]
    edge_sine: Float64[Tensor, "edges"]
    first_rad: Float64[Tensor, "H"]
    limits_m: tuple[float, float]


@lru_cache(maxsize=8)
def _rays_of(sensor: SensorModel, device: torch.device) -> _Rays:
    """Return the rays of a sensor; as in a projection, a row ends midway to its neighbours."""
    row_rad = [math.fsum(row) / len(row) for row in sensor.elevation_rad.double().tolist()]
    edges_rad = [(low + high) / 2 for high, low in pairwise(row_rad)]
    if edges_rad:
        edges_rad = [2 * row_rad[0] - edges_rad[0], *edges_rad, 2 * row_rad[-1] - edges_rad[-1]]
    else:
        edges_rad = [row_rad[0] + _LONE_ROW_RAD / 2, row_rad[0] - _LONE_ROW_RAD / 2]
    rising_rad = torch.tensor(edges_rad[::-1], dtype=torch.float64)
    edge_sine, _ = _sine_and_cosine(rising_rad.clamp(-math.pi / 2, math.pi / 2))  # a row may reach beyond the zenith
    falling = torch.arange(sensor.width) * (2 * math.pi / sensor.width)
    first_rad = (continuous_azimuths_rad(sensor.azimuth_rad) + falling).mean(1).expand(sensor.height)
    fine, kept = _directions(sensor.fine()).to(device), _directions(sensor).to(device)
    limits_m = sensor.range_min_m, sensor.range_max_m
    return _Rays(fine, fine.float(), kept, edge_sine.to(device), first_rad.to(device), limits_m)


def _directions(sensor: SensorModel) -> Float64[Tensor, "3 H W"]:
    up, level = _sine_and_cosine(sensor.elevation_rad.double())
    sine, cosine = _sine_and_cosine(sensor.azimuth_rad.double())
    return torch.stack(torch.broadcast_tensors(level * cosine, level * sine, up))


def _sine_and_cosine(angle_rad: Float64[Tensor, "*n"]) -> tuple[Float64[Tensor, "*n"], Float64[Tensor, "*n"]]:
    """Return both by their series: those of libraries differ in the last bit from processor to processor."""
    quarters = (angle_rad / (math.pi / 2)).round()
    rest = angle_rad - quarters * (math.pi / 2)
    sine, cosine = torch.ones_like(rest), torch.ones_like(rest)
    for term in range(_TERMS, 0, -2):
        sine = 1 - rest * rest / (term * (term + 1)) * sine
        cosine = 1 - rest * rest / (term * (term - 1)) * cosine
    sine, quarter = sine * rest, quarters.long() % 4
    turned = torch.stack((sine, cosine, -sine, -cosine, sine))
    return turned.gather(0, quarter[None])[0], turned.gather(0, quarter[None] + 1)[0]


class _OnRays(NamedTuple):
    """Returns of past scans within one fine column of rays; several may be on one ray.

    Args:
        pixel: number of the ray's pixel.
        is_close: True within half a fine column.
    """

    pixel: Int64[Tensor, "n"]
    range_m: Float64[Tensor, "n"]
    age_s: Float64[Tensor, "n"]
    cos_incidence: Float64[Tensor, "n"]
    offset_rad: Float64[Tensor, "n"]
    is_close: Bool[Tensor, "n"]

    def least(self, key: Float64[Tensor, "n"], size: tuple[int, int]) -> WarpedReturns:
        """Return on each ray the return of least key, of equal ones the first; those of infinite key are left out."""
        none = len(self.pixel)
        least = key.new_full((size[0] * size[1],), torch.inf).scatter_reduce(0, self.pixel, key, "amin")
        number = torch.arange(none, device=key.device).where((key == least[self.pixel]) & key.isfinite(), none)
        first = number.new_full(least.shape, none).scatter_reduce(0, self.pixel, number, "amin").view(size)
        parts = (self.range_m, self.age_s, self.cos_incidence, self.offset_rad)
        return WarpedReturns(*(torch.cat((part, part.new_zeros(1)))[first] for part in parts))

    def surface(self, about_m: Float64[Tensor, "H W"]) -> WarpedSurface:
        """Return the mean of the returns on each ray that are on one surface with a range."""
        own_m = about_m.flatten()[self.pixel]
        on_it = (self.range_m - own_m).abs() <= _ON_SURFACE_M + _ON_SURFACE * own_m
        pixel, range_m = self.pixel[on_it], self.range_m[on_it]
        returns = torch.bincount(pixel, minlength=about_m.numel())
        on_host = pixel.cpu()

        def mean_of(values: Float64[Tensor, "n"]) -> Float64[Tensor, "p"]:
            # On the host, which adds one after the other, so that sums have a fixed order.
            total = torch.bincount(on_host, values.cpu(), about_m.numel())
            return total.to(values) / returns.clamp(min=1)  # of no return at all bincount gives 32 bits

        mean_m = mean_of(range_m)
        spread_m = mean_of((range_m - mean_m[pixel]).abs())
        return WarpedSurface(*(part.view(about_m.shape) for part in (mean_m, spread_m, returns)))

    def close_pixels(self, size: tuple[int, int]) -> Int64[Tensor, "H W"]:
        """Return 1 on each ray with a return within half a fine column."""
        struck = torch.zeros(size[0] * size[1], dtype=torch.long, device=self.pixel.device)
        return struck.index_fill(0, self.pixel[self.is_close], 1).view(size)


def _on_rays(
    range_m: Float[Tensor, "H fine_W"], matrix: Float64[Tensor, "4 4"], age_s: Float64[Tensor, ""], rays: _Rays
) -> _OnRays:
    """Put the returns of one past scan on the rays that they meet."""
    range_m, height, width = range_m.double(), *rays.kept.shape[1:]
    pixel = _maybe_in_reach(range_m, matrix, rays)
    moved_m = _turned(matrix, range_m.flatten()[pixel] * rays.fine.flatten(1)[:, pixel]) + matrix[:3, 3:]
    distance_m = _dot(moved_m, moved_m).sqrt()
    row = height - torch.searchsorted(rays.edge_sine, moved_m[2] / distance_m)
    place = (rays.first_rad[row.clamp(0, height - 1)] - torch.atan2(moved_m[1], moved_m[0])) * (width / (2 * math.pi))
    in_reach = (place - place.round()).abs() <= _SLACK * width / rays.fine.shape[2]
    in_reach &= (row >= 0) & (row < height) & (distance_m >= rays.limits_m[0]) & (distance_m <= rays.limits_m[1])
    pixel, moved_m, distance_m, row = pixel[in_reach], moved_m[:, in_reach], distance_m[in_reach], row[in_reach]
    target, sine = _nearest_pixel(moved_m, row, place[in_reach], rays)
    ray = rays.kept.flatten(1)[:, target]
    new_m, cos_incidence = _corrected(distance_m, moved_m, _turned(matrix, _normals(range_m, rays.fine, pixel)), ray)
    chord = moved_m / distance_m - ray
    column_rad = 2 * math.pi / rays.fine.shape[2]
    offset_rad, is_close = _dot(chord, chord).sqrt(), sine <= math.sin(column_rad / 2)
    found = _OnRays(target, new_m, age_s.expand_as(new_m), cos_incidence, offset_rad, is_close)
    reached = (sine <= math.sin(column_rad)) & (new_m >= rays.limits_m[0]) & (new_m <= rays.limits_m[1])
    return _OnRays(*(part[reached] for part in found))


def _maybe_in_reach(
    range_m: Float64[Tensor, "H fine_W"], matrix: Float64[Tensor, "4 4"], rays: _Rays
) -> Int64[Tensor, "n"]:
    """Return the numbers of the returns that may lie within reach of a ray, by 32 bits and with slack: about a third.

    Where rows begin at azimuths of their own, these are all returns.
    """
    pixel, width = range_m.flatten().nonzero()[:, 0], rays.kept.shape[2]
    if not bool((rays.first_rad == rays.first_rad[0]).all()):
        return pixel
    placed_m = range_m.flatten()[pixel].float() * rays.fine32.flatten(1)[:, pixel]
    x_m, y_m = torch.addmm(matrix[:2, 3:].float(), matrix[:2, :3].float(), placed_m)
    place = (rays.first_rad[0].float() - torch.atan2(y_m, x_m)) * (width / (2 * math.pi))
    return pixel[(place - place.round()).abs() <= _ROUGHLY * _SLACK * width / rays.fine.shape[2]]


def _nearest_pixel(
    moved_m: Float64[Tensor, "3 n"], row: Int64[Tensor, "n"], place: Float64[Tensor, "n"], rays: _Rays
) -> tuple[Int64[Tensor, "n"], Float64[Tensor, "n"]]:
    """Return the pixel of a row whose ray is nearest in azimuth, and the sine of the angle to it.

    Args:
        place: column and its fraction where each return lies, by arc functions that differ between processors: the
            nearer of the two columns around it is decided by products alone.
    """
    width, level_m = rays.kept.shape[2], (moved_m[0] * moved_m[0] + moved_m[1] * moved_m[1]).sqrt()
    columns = torch.stack((place.floor(), place.floor() + 1)).long() % width
    x, y = rays.kept[:2, row, columns]
    sine = (x * moved_m[1] - y * moved_m[0]).abs() / ((x * x + y * y).sqrt() * level_m)
    second = (sine[1] < sine[0]) | ((sine[1] == sine[0]) & (columns[1] < columns[0]))
    return row * width + torch.where(second, columns[1], columns[0]), torch.where(second, sine[1], sine[0])


def _normals(
    range_m: Float64[Tensor, "H fine_W"], fine: Float64[Tensor, "3 H fine_W"], pixel: Int64[Tensor, "n"]
) -> Float64[Tensor, "3 n"]:
    """Return the normal of the plane through the neighbours of each pixel; 0 where too few of one surface returned."""
    along, up = (_tangent(range_m, fine, pixel, *step) for step in ((0, _BESIDE), (1, 0)))
    normal = torch.stack(
        (along[1] * up[2] - along[2] * up[1], along[2] * up[0] - along[0] * up[2], along[0] * up[1] - along[1] * up[0])
    )
    length = _dot(normal, normal).sqrt()
    return torch.where(length > 0, normal / length, 0.0)


def _tangent(
    range_m: Float64[Tensor, "H fine_W"],
    fine: Float64[Tensor, "3 H fine_W"],
    pixel: Int64[Tensor, "n"],
    down: int,
    right: int,
) -> Float64[Tensor, "3 n"]:
    """Return the step between two opposite neighbours of a pixel, or from one to the pixel; 0 where both lack."""
    height, width = range_m.shape
    own_m, direction = range_m.flatten()[pixel], fine.flatten(1)
    ends = []
    for sign in (-1, 1):
        row = pixel // width + sign * down
        neighbour = row.clamp(0, height - 1) * width + (pixel + sign * right) % width
        its_m = range_m.flatten()[neighbour]
        exists = (row >= 0) & (row < height) & (its_m > 0) & ((its_m - own_m).abs() <= _SAME_SURFACE * own_m)
        other = torch.where(exists, neighbour, pixel)
        ends.append(range_m.flatten()[other] * direction[:, other])
    return ends[1] - ends[0]


def _corrected(
    distance_m: Float64[Tensor, "n"],
    moved_m: Float64[Tensor, "3 n"],
    normal: Float64[Tensor, "3 n"],
    ray: Float64[Tensor, "3 n"],
) -> tuple[Float64[Tensor, "n"], Float64[Tensor, "n"]]:
    """Return the range at which each ray meets the plane of a return, and the cosine of incidence."""
    cosine = _dot(normal, ray)
    on_plane_m = _dot(normal, moved_m) / cosine
    follows = (cosine.abs() >= _COS_AT_LEAST) & ((on_plane_m - distance_m).abs() <= _CORRECTION_AT_MOST * distance_m)
    return torch.where(follows, on_plane_m, distance_m), cosine.abs()


def _turned(matrix: Float64[Tensor, "4 4"], vectors: Float64[Tensor, "3 n"]) -> Float64[Tensor, "3 n"]:
    return torch.stack([_dot(matrix[row, :3, None], vectors) for row in range(3)])


def _dot(one: Float64[Tensor, "3 #n"], other: Float64[Tensor, "3 n"]) -> Float64[Tensor, "n"]:
    """Return products of vectors, summed in a fixed order."""
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]

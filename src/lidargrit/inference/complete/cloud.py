"""A cloud and what a model made of its images → the whole cloud: measured points as they are, then filled ones."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int, Int64
from scipy.spatial import KDTree
from torch import Tensor

from lidargrit.inference.complete.grid import RayGrid
from lidargrit.inference.complete.inputs import InputScan
from lidargrit.scans.condition import Observed
from lidargrit.scans.fills import along_rows
from lidargrit.scans.projection import unproject
from lidargrit.scans.projection.sensor_check import elevations_deg
from lidargrit.scans.types import RangeImage, Scan


@dataclass(frozen=True, eq=False)
class CompletedScan:
    """A scan with points that a model added, or without those that it dropped.

    Args:
        scan: scan as it was given, with the ring of its points where its rows went by ring.
        kept: True for points that stay.
        filled: points that were added, each on a ray; None for none.
    """

    scan: Scan
    kept: Bool[Tensor, "n"]
    filled: Scan | None = None

    def whole(self) -> Scan:
        """Return the points that stay, in their order and bit for bit, then those that were added.

        Reflectance, ring and label are there where the scan has them; ``filled`` marks what was added, whose times are
        those of the points nearest to its rays.
        """
        own, added = replace(self.scan.select(self.kept), rows=None), self.filled
        if added is None:
            return own
        marks = torch.zeros(len(own), dtype=torch.bool) if own.filled is None else own.filled
        fired_s = None if self.scan.point_time_s is None else self.scan.point_time_s[self.nearest_kept()]
        return replace(
            own,
            points_xyz_m=torch.cat((own.points_xyz_m, added.points_xyz_m)),
            reflectance=_joined(own.reflectance, added.reflectance),
            ring=_joined(own.ring, added.ring),
            label=_joined(own.label, added.label),
            filled=torch.cat((marks, torch.ones(len(added), dtype=torch.bool))),
            point_time_s=_joined(own.point_time_s, fired_s),
        )

    def nearest_kept(self) -> Int64[np.ndarray, "m"]:
        """Return for each added point which point of the scan that stays lies nearest to its ray."""
        assert self.filled is not None
        stays = np.flatnonzero(self.kept.numpy())
        tree = KDTree(_directions(self.scan.points_xyz_m[self.kept]))
        return stays[tree.query(_directions(self.filled.points_xyz_m))[1]]


def filled_scan(seen: InputScan, condition: Observed, images: RangeImage, hides: bool) -> CompletedScan:
    """Return a scan with a point on every ray that lacked one and returns by the model.

    A ray on which a point was measured keeps that alone. An added point has the range that the model gives, in the
    median over half of a model's column to either side; between two measured points of one surface that are no farther
    apart than two columns of the model, it lies between them.

    Args:
        seen: scan on its rays, which are several images of the model.
        hides: whether measured points outside the observed pixels are left out.
    """
    grid = seen.rays
    completed, observed = grid.joined(images), _on_grid(condition.return_observed, grid)
    scan, taken = seen.cloud, seen.taken()
    kept = torch.ones(len(scan), dtype=torch.bool)
    if hides:
        kept = observed[seen.coordinates.row.clip(0, grid.sensor.height - 1), seen.coordinates.column]
        taken = taken & observed
    new = completed.return_mask & ~observed & ~taken
    if not bool(new.any()):
        return CompletedScan(_with_rows(seen), kept)
    known = seen.image.return_mask & observed
    range_m = _smoothed(completed.range_m.double().numpy(), known.numpy(), grid.phases // 4)
    measured_m = np.where(known.numpy(), seen.image.range_m.double().numpy(), 0)
    azimuth_rad = grid.sensor.azimuth_rad.double().mean(0).numpy()
    between_m = along_rows(measured_m, azimuth_rad, (grid.phases + 0.5) * 2 * np.pi / grid.sensor.width)
    range_m = torch.from_numpy(np.where(between_m > 0, between_m, range_m)).float()
    image = RangeImage.masked(range_m, new, grid.sensor, completed.planes)
    filled = unproject(image)
    return CompletedScan(_with_rows(seen), kept, replace(filled, ring=_rings_of_added(seen, filled)))


def dropped_scan(seen: InputScan, condition: Observed, images: RangeImage) -> CompletedScan:
    """Return a scan without the points that do not return by the model.

    All points of a pixel share its decision. Points without a pixel, above or below all rows or beyond the limits of
    range, follow the nearest ray by angle that has one. If the model writes reflectance, it takes the place of theirs.

    Args:
        seen, condition, images: arguments of :func:`filled_scan`.
    """
    grid = seen.rays
    completed, surface = grid.joined(images), _on_grid(condition.range_observed, grid)
    scan, pixels = seen.cloud, seen.coordinates
    row, column = pixels.row.clip(0, grid.sensor.height - 1).astype(np.int64), pixels.column.astype(np.int64)
    decided = pixels.in_rows() & surface.numpy()[row, column]
    rows, columns = np.nonzero(surface.numpy())
    rays = grid.sensor.ray_directions()[rows, columns].double().numpy()
    nearest = KDTree(rays).query(_directions(scan.points_xyz_m)[~decided])[1]
    row[~decided], column[~decided] = rows[nearest], columns[nearest]
    if completed.reflectance is not None:
        scan = replace(scan, reflectance=completed.reflectance[row, column], rows=None)
    return CompletedScan(scan, completed.return_mask[row, column])


def _on_grid(masks: Bool[Tensor, "P H W"], grid: RayGrid) -> Bool[Tensor, "H columns"]:
    return masks.movedim(0, -1).reshape(grid.sensor.height, grid.sensor.width)


def _smoothed(
    range_m: Float64[np.ndarray, "H W"], known: Bool[np.ndarray, "H W"], aside: int
) -> Float64[np.ndarray, "H W"]:
    """Return ranges in the median over so many columns on either side, of those that are not known and return.

    Neighbouring columns are estimated in different images, and so differ by more than their surfaces do.
    """
    if not aside:
        return range_m
    own = np.where((range_m > 0) & ~known, range_m, np.nan)
    window = np.stack([np.roll(own, step, axis=1) for step in range(-aside, aside + 1)])
    window.sort(axis=0)  # those without a value come last
    count = np.isfinite(window).sum(axis=0)
    low, high = ((np.maximum(count - part, 0) // 2)[None] for part in (1, 0))
    middle = (np.take_along_axis(window, low, axis=0) + np.take_along_axis(window, high, axis=0))[0] / 2
    return np.where(np.isfinite(own), middle, range_m)


def _with_rows(seen: InputScan) -> Scan:
    """Return the scan with the ring of its points, where its rows went by ring and its file does not name them."""
    scan, row = seen.cloud, seen.coordinates.row
    if scan.ring is not None or not seen.by_ring or not bool(seen.coordinates.in_rows().all()):
        return scan
    return replace(scan, ring=torch.from_numpy(row.astype(np.int64)))


def _rings_of_added(seen: InputScan, added: Scan) -> Int[Tensor, "m"] | None:
    """Return the ring of added points: their row, or the laser of the scan that looks most nearly as high."""
    ring = seen.cloud.ring
    if ring is None or seen.by_ring:
        return added.ring
    numbers, of_point = np.unique(ring.numpy(), return_inverse=True)
    elevation = elevations_deg(seen.cloud.points_xyz_m)
    of_laser = np.bincount(of_point, elevation) / np.bincount(of_point)
    order = np.argsort(of_laser)
    borders = (of_laser[order][1:] + of_laser[order][:-1]) / 2
    return torch.from_numpy(numbers[order][np.searchsorted(borders, elevations_deg(added.points_xyz_m))])


def _joined(own: Tensor | None, added: Tensor | None) -> Tensor | None:
    return None if own is None or added is None else torch.cat((own, added.to(own)))


def _directions(points_xyz_m: Tensor) -> Float64[np.ndarray, "n 3"]:
    points = points_xyz_m.double().numpy()
    return points / np.linalg.norm(points, axis=1, keepdims=True)

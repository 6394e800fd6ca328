"""A cloud as another sensor would see it: its own points, on whose rays the other sensor looks."""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float64
from scipy.spatial import KDTree
from torch import Tensor

from lidargrit.core.errors import ConfigError, ScanError
from lidargrit.core.untrusted import RAISED_AT_MOST_M
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import Scan

_BESIDE = 0.75  # of the spacing of rays: two rays of the cloud are never farther from a ray between them
_CANDIDATES = 8  # nearest points of which the one in front hides the others, once the sensor has moved


class Rescanned(NamedTuple):
    """A cloud as another sensor sees it.

    Args:
        scan: points that it sees, measured ones all, with the other sensor's ring.
        rays: number of the other sensor's rays.
        without_rows: number of them that look above or below all rows of the sensor that made the cloud.
    """

    scan: Scan
    rays: int
    without_rows: int

    @property
    def told(self) -> str:
        """How many rays have a point, in words."""
        look = f"; {self.without_rows:,} look where the scans have no rows" if self.without_rows else ""
        return f"{len(self.scan):,} of {self.rays:,} rays get a point of the first scan{look}"


@dataclass(frozen=True, eq=False)
class Rescan:
    """What turns clouds of one sensor into those of another.

    Each ray of the other sensor gets the point of the cloud whose ray lies nearest, if that is within three quarters of
    the spacing of rays there, and no point serves two rays. So no point is made up and none moves, and where the cloud
    has no rays, none are told. Drops are those of the cloud. A sensor that is raised sees from the same points those
    that stand in front; what the first sensor did not see stays unseen.

    Args:
        other: sensor whose clouds are wanted.
        raised_m: height in metres of the other sensor above the first; points are in its own frame.
    """

    sensor: SensorModel
    other: SensorModel
    raised_m: float = 0.0

    def __post_init__(self) -> None:
        if not abs(self.raised_m) <= RAISED_AT_MOST_M:
            wanted = f"{-RAISED_AT_MOST_M:g} to {RAISED_AT_MOST_M:g} metres"
            raise ConfigError(f"a sensor raised by {self.raised_m:g} m", wanted, "correct it")

    def identity(self) -> dict[str, Any]:
        """Return entries of a manifest by which its scans are told from others."""
        return {"to": self.other.to_json(), "of": self.sensor.to_json(), "raised_m": self.raised_m}

    def pose(self, pose: Float64[Tensor, "4 4"] | None) -> Float64[Tensor, "4 4"] | None:
        """Return the pose of the other sensor by that of the first."""
        if pose is None:
            return None
        raised = torch.eye(4, dtype=torch.float64)
        raised[2, 3] = self.raised_m
        return pose @ raised

    def __call__(self, scan: Scan) -> Rescanned:
        """Return a cloud as the other sensor sees it."""
        points_xyz_m = scan.points_xyz_m.clone()
        points_xyz_m[:, 2] -= self.raised_m
        xyz = points_xyz_m.double().numpy()
        range_m = np.linalg.norm(xyz, axis=1)
        within = np.flatnonzero((range_m >= self.other.range_min_m) & (range_m <= self.other.range_max_m))
        other = self.other
        if other.column_stride > 1:  # a sensor fires in all columns, of which an image may keep some
            other = other.with_columns(other.width * other.column_stride, 1)
        rays = other.ray_directions().double().flatten(0, 1).numpy()
        wanted = self._spaced(rays)
        known = np.abs(wanted[:, 1] - (self.sensor.height - 1) / 2) <= self.sensor.height / 2
        chosen = self._chosen(self._spaced(xyz[within]), range_m[within], wanted[known])
        points, rows = within[chosen[:, 1]], np.flatnonzero(known)[chosen[:, 0]] // other.width
        if not len(points):
            got = f"{scan.source}, of which the sensor {self.other.name!r} sees no point"
            raise ScanError(got, "clouds whose rays it shares", "check --sensor, or choose another --to")
        moved = replace(scan, points_xyz_m=points_xyz_m, pose=self.pose(scan.pose), rows=None)
        seen = replace(moved.select(torch.from_numpy(points)), ring=torch.from_numpy(rows.astype(np.int64)))
        return Rescanned(seen, len(rays), int((~known).sum()))

    def _spaced(self, xyz: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 2"]:
        """Return column and row of directions on the first sensor's grid, where its rays are 1 apart."""
        azimuth_rad = np.arctan2(xyz[:, 1], xyz[:, 0])
        elevation_rad = np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))
        columns = self.sensor.width * self.sensor.column_stride
        column = (self.sensor.first_edge_rad - azimuth_rad) / (2 * np.pi) * columns % columns
        rows_rad = self.sensor.elevation_rad.double().mean(1).numpy()
        row = np.interp(-elevation_rad, -rows_rad, np.arange(len(rows_rad)))
        if len(rows_rad) > 1:  # beyond the outermost rows, in their spacing
            above, below = rows_rad[0] - rows_rad[1], rows_rad[-2] - rows_rad[-1]
            row -= np.clip(elevation_rad - rows_rad[0], 0, None) / above
            row += np.clip(rows_rad[-1] - elevation_rad, 0, None) / below
        return np.stack((np.minimum(column, np.nextafter(columns, 0)), row), axis=1)

    def _chosen(
        self, points: Float64[np.ndarray, "n 2"], range_m: Float64[np.ndarray, "n"], rays: Float64[np.ndarray, "m 2"]
    ) -> np.ndarray:
        """Return pairs (k, 2) of a ray and its point, each of them once, in the order of the rays."""
        columns = self.sensor.width * self.sensor.column_stride
        low = points[:, 1].min(initial=0.0) - 1, rays[:, 1].min(initial=0.0) - 1
        tree = KDTree(points - [0, min(low)], boxsize=[columns, 0])
        found = tree.query(rays - [0, min(low)], k=_CANDIDATES, distance_upper_bound=_BESIDE)
        distance, nearest = np.asarray(found[0]), np.asarray(found[1])
        first = np.zeros(len(rays), dtype=np.int64)
        if self.raised_m:  # of the points near a ray, that in front
            of_near = np.append(range_m, np.inf)[nearest]  # the tree gives the number of points where there is none
            first = of_near.argmin(1)
        every = np.arange(len(rays))
        apart, point = distance[every, first], nearest[every, first]
        ray = np.flatnonzero(np.isfinite(apart))
        point, apart = point[ray], apart[ray]
        order = np.lexsort((ray, apart, point))
        once = order[np.flatnonzero(np.diff(point[order], prepend=-1))]
        return np.stack((ray[once], point[once]), axis=1)[np.argsort(ray[once], kind="stable")]

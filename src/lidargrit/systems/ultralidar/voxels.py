"""Points → occupied voxels about the sensor, and voxels → points, or range images along the sensor's rays."""

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidargrit.core.configuration import Settings
from lidargrit.core.errors import ConfigError
from lidargrit.core.typed_values import Count, Positive
from lidargrit.scans.projection.image import points_of_pixels
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage

VoxelVariant = Literal["exact", "reference"]
"""Where a voxel's point lies: at its centre, or where UltraLiDAR's program writes it (see :func:`points_of_voxels`)."""

_STEPS_BETWEEN_CHECKS = 16  # of rays, before those that have ended are left behind
_NEVER_M, _ROUNDING_M = 1e30, 1e-9
_CELLS_AT_MOST = 1 << 26  # four times the published grid; a float a cell is 268 MB


@dataclass(frozen=True)
class VoxelGrid(Settings):
    """A box of equal cells about the sensor; the defaults are UltraLiDAR's for KITTI-360.

    Args:
        low_m: smallest x, y and z of the box, in metres, in the sensor's frame.
        cell_m: sides of a cell along x, y and z, in metres.
        cells: number of cells along x, y and z.

    Source:
        myc634/UltraLiDAR_nusc_waymo@eb65fe0 (MIT), configuration for KITTI-360.
    """

    low_m: tuple[float, float, float] = (-50.0, -50.0, -3.73)
    cell_m: tuple[Positive, Positive, Positive] = (0.15625, 0.15625, 0.15)
    cells: tuple[Count, Count, Count] = (640, 640, 40)

    def __post_init__(self) -> None:
        super().__post_init__()
        if math.prod(self.cells) > _CELLS_AT_MOST:
            raise ConfigError(f"cells={self.cells}", f"at most {_CELLS_AT_MOST:,} cells in all", "take larger cells")
        high = [low + side * count for low, side, count in zip(self.low_m, self.cell_m, self.cells, strict=True)]
        if not all(low < 0 < top for low, top in zip(self.low_m, high, strict=True)):
            raise ConfigError(
                f"a box from {self.low_m} to {tuple(high)} m", "the sensor, at 0, inside", "change low_m or cells"
            )

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of cells along z, y and x, the axes of a tensor of voxels."""
        return self.cells[2], self.cells[1], self.cells[0]

    def swapped(self) -> "VoxelGrid":
        """Return the grid whose x axis is this one's y axis, and the other way round."""
        low_m, cell_m, cells = ((of[1], of[0], of[2]) for of in (self.low_m, self.cell_m, self.cells))
        return replace(self, low_m=low_m, cell_m=cell_m, cells=cells)


def occupied_voxels(
    points_xyz_m: Float[Tensor, "B n 3"], eligible: Bool[Tensor, "B n"], grid: VoxelGrid
) -> Bool[Tensor, "B z y x"]:
    """Return which voxels hold a point; points outside the box are left out."""
    low, side = (torch.tensor(of, dtype=torch.float32, device=points_xyz_m.device) for of in (grid.low_m, grid.cell_m))
    index = ((points_xyz_m.float() - low) / side).floor()  # in 32 bits, as the program: rounding decides at borders
    inside = eligible & ((index >= 0) & (index < index.new_tensor(grid.cells))).all(dim=-1)
    x, y, z = index.long().unbind(dim=-1)
    outside = math.prod(grid.cells)  # a further cell, for all points that count nowhere
    cell = torch.where(inside, (z * grid.cells[1] + y) * grid.cells[0] + x, outside)
    occupied = torch.zeros(len(cell), outside + 1, dtype=torch.bool, device=cell.device).scatter_(1, cell, True)
    return occupied[:, :outside].unflatten(1, grid.shape)


def voxels_of_images(images: RangeImage, grid: VoxelGrid) -> Bool[Tensor, "B z y x"]:
    """Return which voxels hold the return of a pixel, which lies on the centre of the pixel's ray."""
    return occupied_voxels(points_of_pixels(images).flatten(1, 2), images.return_mask.flatten(1), grid)


def points_of_voxels(
    occupied: Bool[Tensor, "z y x"], grid: VoxelGrid, variant: VoxelVariant = "exact"
) -> Float[Tensor, "n 3"]:
    """Return one point in metres for each occupied voxel of one scan, by height, then y, then x.

    Args:
        variant: ``exact`` is x, y and z of the centres. ``reference`` is what the program writes: the lower corners,
            with y before x.

    Source:
        myc634/UltraLiDAR_nusc_waymo@eb65fe0 (MIT), voxels2points.
    """
    index = occupied.nonzero().flip(dims=(1,)).float()  # x, y, z
    if variant == "reference":
        grid, index = grid.swapped(), index[:, [1, 0, 2]]
    else:
        index += 0.5
    return index * index.new_tensor(grid.cell_m) + index.new_tensor(grid.low_m)


def images_of_voxels(
    occupied: Bool[Tensor, "B z y x"], grid: VoxelGrid, sensor: SensorModel, variant: VoxelVariant = "exact"
) -> RangeImage:
    """Return range images in which every ray ends at the first occupied voxel that it meets.

    The range is that of the voxel's centre, measured along the ray. The surface is somewhere in the voxel: where the
    ray enters it, all ranges would be half a cell or more too short. A ray that meets no occupied voxel, or only
    voxels beyond the sensor's limits, has no return; a range that the centre puts beyond them becomes the limit.

    Args:
        variant: ``exact``, or ``reference`` for a picture of the clouds that UltraLiDAR's program writes: x and y are
            swapped, and the lower corner stands for the centre.
    """
    share = 0.5
    if variant == "reference":
        occupied, grid, share = occupied.transpose(-1, -2), grid.swapped(), 0.0
    flat = occupied.flatten(1)
    rays = _Rays(sensor, grid, share, flat.device)
    range_m = torch.zeros(len(flat), sensor.height * sensor.width, dtype=torch.float64, device=flat.device)
    while len(rays.pixel):
        found_m = range_m[:, rays.pixel]
        for _ in range(_STEPS_BETWEEN_CHECKS):
            in_limits = (rays.exit_m >= sensor.range_min_m) & (rays.entry_m <= sensor.range_max_m)
            ends = flat[:, rays.voxel] & in_limits & (found_m == 0)
            found_m = torch.where(ends, rays.along_m.clamp(sensor.range_min_m, sensor.range_max_m), found_m)
            rays.advance()
        range_m[:, rays.pixel] = found_m
        rays.keep((found_m == 0).any(dim=0))
    limited_m = range_m.float().unflatten(1, (sensor.height, sensor.width))
    return RangeImage(limited_m, limited_m > 0, sensor)


class _Rays:
    """Rays from the sensor, each at its next voxel, until the last one in the box, where they stay.

    Source:
        Amanatides and Woo, A Fast Voxel Traversal Algorithm for Ray Tracing, Eurographics 1987.
    """

    def __init__(self, sensor: SensorModel, grid: VoxelGrid, share: float, device: torch.device) -> None:
        low, side = (torch.tensor(of, dtype=torch.float64, device=device)[:, None] for of in (grid.low_m, grid.cell_m))
        direction = sensor.ray_directions().to(device).double().flatten(0, 1).T  # (3, rays)
        cells = torch.tensor(grid.cells, device=device)[:, None]
        first = (-low / side).floor()  # the sensor's own cell
        self.pixel: Int[Tensor, "rays"] = torch.arange(direction.shape[1], device=device)
        self.voxel: Int[Tensor, "rays"]
        """Index of each ray's voxel among all, in the order z, y, x."""
        self.along_m: Float[Tensor, "rays"]
        """Distance along the ray to the centre of its voxel, or, with a share of 0, to its lower corner."""
        rows = torch.tensor([[1], [grid.cells[0]], [grid.cells[0] * grid.cells[1]]], device=device)
        self.voxel = (first.long() * rows).sum().expand(len(self.pixel))
        self.along_m = (((first + share) * side + low) * direction).sum(dim=0)
        # By axis: the distance to the next border across it and between two, and what a step over one changes.
        moves, ahead = direction != 0, direction > 0
        self._next_m = torch.where(moves, ((first + ahead) * side + low) / direction, _NEVER_M)
        self._between_m = torch.where(moves, side / direction.abs(), 0.0)
        self._voxels = torch.where(ahead, rows, -rows)
        self._farther_m = side * direction.abs()
        leaves_m = torch.where(moves, (torch.where(ahead, cells, 0) * side + low) / direction, _NEVER_M)
        self._end_m = leaves_m.min(dim=0).values - _ROUNDING_M
        self.entry_m: Float[Tensor, "rays"] = torch.zeros_like(self.along_m)
        self.exit_m: Float[Tensor, "rays"] = self._next_m.min(dim=0).values
        """Distances along the ray at which it enters and leaves its voxel."""

    def advance(self) -> None:
        self._moved = self.exit_m < self._end_m
        step = (self._next_m == self.exit_m) & self._moved
        self.voxel = self.voxel + (self._voxels * step).sum(dim=0)
        self.along_m = self.along_m + (self._farther_m * step).sum(dim=0)
        self._next_m = self._next_m + self._between_m * step
        self.entry_m, self.exit_m = self.exit_m, self._next_m.min(dim=0).values

    def keep(self, wanted: Bool[Tensor, "rays"]) -> None:
        """Go on with some of the rays, and of these with those that are not at their last voxel already."""
        on = wanted & self._moved
        self.pixel, self.voxel = self.pixel[on], self.voxel[on]
        self.along_m, self.entry_m, self.exit_m, self._end_m = (
            of[on] for of in (self.along_m, self.entry_m, self.exit_m, self._end_m)
        )
        self._next_m, self._between_m, self._voxels, self._farther_m = (
            of[:, on] for of in (self._next_m, self._between_m, self._voxels, self._farther_m)
        )

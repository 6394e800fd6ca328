"""The scans of a drive before the present one, as range images with their poses → :class:`Past`."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Float64, Int
from torch import Tensor

from lidargrit.core.errors import ConfigError, ScanError
from lidargrit.scans.condition import Condition
from lidargrit.scans.sensors import SensorModel

_ROTATION = 1e-3  # by which numbers of a file may miss an orthonormal matrix


@dataclass(frozen=True, eq=False)
class Past(Condition):
    """The past of each scan of a batch: K scans of one drive in order of time, the latest last.

    A scan that is not there, as before the first of a drive, is an image without a return.

    Args:
        range_m: range images in metres in all fine columns, 0 where nothing returned, kept in 32 bits.
        transforms: matrix from the sensor's frame at each past scan to that at the present one, in metres.
        ages_s: time from each past scan to the present one, in seconds.
        sensor: sensor of the present images; the past ones have all fine columns of it.

    Raises:
        ConfigError: images, matrices or ages of another size.
        ScanError: a range below 0 or not finite, a matrix that is no rotation and place, or an age below 0.
    """

    range_m: Float[Tensor, "B K H fine_W"]
    transforms: Float64[Tensor, "B K 4 4"]
    ages_s: Float64[Tensor, "B K"]
    sensor: SensorModel

    def __post_init__(self) -> None:
        object.__setattr__(self, "range_m", self.range_m.float())
        given = (self.range_m.shape, self.transforms.shape, self.ages_s.shape)
        batch, scans = self.range_m.shape[:2]
        fine = self.sensor.height, self.sensor.width * self.sensor.column_stride
        if given != ((batch, scans, *fine), (batch, scans, 4, 4), (batch, scans)):
            got = f"past scans, transforms and ages of {', '.join(str(tuple(shape)) for shape in given)}"
            raise ConfigError(got, f"(B, K, {fine[0]}, {fine[1]}), (B, K, 4, 4) and (B, K)", "keep all fine columns")
        if not bool(((self.range_m >= 0) & self.range_m.isfinite()).all()):
            raise ScanError("a range of the past below 0, NaN or infinite", "metres, 0 for no return", "mask it")
        if not bool(((self.ages_s >= 0) & self.ages_s.isfinite()).all()):
            raise ScanError("a past scan after the present one", "ages of 0 seconds or more", "order them by time")
        turns = self.transforms[..., :3, :3]
        apart = (turns @ turns.mT - torch.eye(3, dtype=turns.dtype, device=turns.device)).abs()
        last = self.transforms[..., 3, :] - torch.tensor([0.0, 0, 0, 1]).to(turns)
        proper = torch.linalg.det(turns) > 0
        if not bool((apart < _ROTATION).all() & (last == 0).all() & proper.all() & self.transforms.isfinite().all()):
            raise ScanError("a transform that is no rotation and place", "matrices between frames", "restore the poses")

    @classmethod
    def nothing(cls, sensor: SensorModel, count: int, scans: int) -> "Past":
        """Return the past of scans before which there was none.

        Args:
            count: number of present scans, B.
            scans: number of past scans of each, K, all without a return.
        """
        images = torch.zeros(count, scans, sensor.height, sensor.width * sensor.column_stride)
        still = torch.eye(4, dtype=torch.float64).expand(count, scans, 4, 4).clone()
        return cls(images, still, torch.zeros(count, scans, dtype=torch.float64), sensor)

    def turned(self, fine_columns: Int[Tensor, "B"]) -> "Past":
        """Return the past of images that begin at another fine column, as if the sensor had been mounted turned.

        Args:
            fine_columns: number of the fine column that becomes the first, of each scan.
        """
        width = self.range_m.shape[-1]
        column = (torch.arange(width, device=self.range_m.device) + fine_columns[:, None]) % width
        range_m = self.range_m.gather(-1, column[:, None, None].expand_as(self.range_m))
        return self._seen_by(range_m, _turn(fine_columns.double() * (2 * math.pi / width)))

    def mirrored(self, which: Bool[Tensor, "B"]) -> "Past":
        """Return the past of images that are mirrored left and right, so that their last column is the first.

        Args:
            which: True for the scans that are mirrored.
        """
        sensor, width = self.sensor, self.range_m.shape[-1]
        last = (sensor.width - 1) * sensor.column_stride  # fine column of the last one that the image keeps
        column = (last - torch.arange(width, device=self.range_m.device)) % width
        mirrored_m = self.range_m[..., column]
        # Azimuth a becomes that of the first column plus that of the last one minus a.
        sum_rad = 2 * sensor.first_edge_rad - 2 * math.pi * (last + 1) / width
        matrix = _turn(torch.full((1,), sum_rad, dtype=torch.float64)) @ torch.tensor([1.0, -1, 1, 1]).double().diag()
        other = self._seen_by(mirrored_m, matrix)
        range_m = torch.where(which[:, None, None, None], other.range_m, self.range_m)
        transforms = torch.where(which[:, None, None, None], other.transforms, self.transforms)
        return Past(range_m, transforms, self.ages_s, sensor)

    def _seen_by(self, range_m: Float[Tensor, "B K H fine_W"], new_of_old: Float64[Tensor, "#B 4 4"]) -> "Past":
        """Return other images with the transforms between the new frames of all scans."""
        changed = new_of_old.to(self.transforms)[:, None]
        return Past(range_m, changed @ self.transforms @ torch.linalg.inv(changed), self.ages_s, self.sensor)


def _turn(angle_rad: Float64[Tensor, "B"]) -> Float64[Tensor, "B 4 4"]:
    """Return matrices that turn counter-clockwise about the vertical axis."""
    turned = torch.eye(4, dtype=torch.float64, device=angle_rad.device).repeat(len(angle_rad), 1, 1)
    turned[:, 0, 0] = turned[:, 1, 1] = angle_rad.cos()
    turned[:, 1, 0] = angle_rad.sin()
    turned[:, 0, 1] = -angle_rad.sin()
    return turned

"""Ranges in whole steps of some millimetres, between a sensor's limits: metres ⇄ integers."""

import math
from dataclasses import dataclass, replace
from numbers import Integral

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidargrit.core.errors import ConfigError
from lidargrit.core.untrusted import STEP_MM_AT_MOST
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage


@dataclass(frozen=True)
class RangeSteps:
    """The whole multiples of a step that a sensor's ranges are rounded to.

    Multiple k stands for all ranges that are nearer to it than to another one, between the limits of the sensor: the
    first and the last interval end there.
    """

    sensor: SensorModel
    step_mm: int

    def __post_init__(self) -> None:
        if not (isinstance(self.step_mm, Integral) and 1 <= self.step_mm <= STEP_MM_AT_MOST):
            raise ConfigError(
                f"a step of {self.step_mm} mm",
                f"a whole number of millimetres from 1 to {STEP_MM_AT_MOST}",
                "take 10 for a centimetre",
            )

    @property
    def first(self) -> int:
        """Multiple that the shortest range of the sensor is rounded to; at least 1, since 0 is no return."""
        return max(1, math.floor(self.sensor.range_min_m * 1000 / self.step_mm + 0.5))  # its interval has a width

    @property
    def last(self) -> int:
        """Multiple that the longest range of the sensor is rounded to."""
        return max(self.first, math.ceil(self.sensor.range_max_m * 1000 / self.step_mm - 0.5))

    def indices(self, range_m: Float[Tensor, "*P"]) -> Int[Tensor, "*P"]:
        """Return the multiple that each range is rounded to; a range beyond the limits is taken to be at them."""
        return (range_m.double() * 1000 / self.step_mm).round().long().clamp(self.first, self.last)

    def range_m(self, indices: Int[Tensor, "*P"]) -> Float[Tensor, "*P"]:
        """Return multiples in metres, in 32 bits."""
        return (indices.double() * self.step_mm / 1000).float()

    def edges_m(self, indices: Int[Tensor, "*P"]) -> tuple[Float[Tensor, "*P"], Float[Tensor, "*P"]]:
        """Return the two ends of the interval that each multiple stands for, in metres and 64 bits."""
        low, high = ((indices.double() + half) * self.step_mm / 1000 for half in (-0.5, 0.5))
        low = torch.where(indices <= self.first, self.sensor.range_min_m, low)
        return low, torch.where(indices >= self.last, self.sensor.range_max_m, high)

    def round(self, images: RangeImage) -> RangeImage:
        """Return images whose ranges are whole multiples of the step."""
        slack_m = self.step_mm / 2000
        near_m, far_m = self.sensor.range_min_m - slack_m, self.sensor.range_max_m + slack_m
        if bool((images.return_mask & ((images.range_m < near_m) | (images.range_m > far_m))).any()):
            raise ConfigError(
                "returns beyond the limits of the sensor",
                f"ranges from {self.sensor.range_min_m:g} to {self.sensor.range_max_m:g} m",
                "project the scans with the sensor of the model",
            )
        rounded = self.range_m(self.indices(images.range_m))
        return replace(images, range_m=torch.where(images.return_mask, rounded, 0.0))

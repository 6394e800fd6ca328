"""What is kept of every image of two sets → a number: the part that metrics of sets have in common."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar

import numpy as np
import torch

from lidargrit.errors import ConfigError
from lidargrit.metrics import Metric
from lidargrit.sensors import SensorModel
from lidargrit.structures import MetricResult, RangeImage

_CHUNK = 8  # images at a time: the points of 64x1024 pixels take 6 MB

Kind = tuple[int, int, float, float]  # rows, columns, shortest and longest range


class SetMetric(Metric):
    """Keeps some numbers of every image, or their sum over the images of a set, and compares what two sets have kept.

    Raises:
        ConfigError: images of two sizes or two pairs of range limits.
    """

    higher_is_better = False
    adds_up: ClassVar[bool] = False
    """Whether only the sum over images is kept, so that memory does not grow with the sets."""

    def __init__(self, *, variant: str | None = None, seed: int = 0) -> None:
        super().__init__(variant=variant, seed=seed)
        self._kind: Kind | None = None
        self._kept: dict[bool, list[np.ndarray]] = {False: [], True: []}
        self._images = {False: 0, True: 0}

    @abstractmethod
    def keep(self, images: RangeImage) -> np.ndarray:
        """Return what is kept of a batch: one row an image, or the sum over the batch if the metric adds up."""

    @abstractmethod
    def compare(self, generated: np.ndarray, real: np.ndarray) -> tuple[float, dict[str, Any]]:
        """Return the value and the details for what is kept of two sets."""

    @torch.no_grad()
    def update(self, images: RangeImage, *, real: bool) -> None:
        """Take in a batch of images, on the CPU."""
        self._require_kind(kind_of(images.sensor))
        images = images.to("cpu") if images.range_m.ndim == 3 else RangeImage.stack([images.to("cpu")])
        for first in range(0, len(images), _CHUNK):
            chunk = images[first : first + _CHUNK]
            self._add(real, [self.keep(chunk)], len(chunk))

    def compute(self) -> MetricResult:
        """Return the number for all images so far."""
        counts = self._images[False], self._images[True]
        self.require_images(*counts, at_least=2)
        value, details = self.compare(np.concatenate(self._kept[False]), np.concatenate(self._kept[True]))
        return MetricResult(self.name, value, self.higher_is_better, *counts, self.variant, details)

    def merge(self, other: Metric) -> None:
        """Take in what another process has kept."""
        self.require_same_options(other)
        assert isinstance(other, SetMetric)
        if other._kind is None:
            return
        self._require_kind(other._kind)
        for real, kept in other._kept.items():
            self._add(real, kept, other._images[real])

    def _add(self, real: bool, kept: list[np.ndarray], num_images: int) -> None:
        mine = self._kept[real] + kept
        self._kept[real] = [sum(mine[1:], start=mine[0])] if self.adds_up and mine else mine
        self._images[real] += num_images

    def _require_kind(self, kind: Kind) -> None:
        known = self._kind or kind
        if kind != known:
            raise ConfigError(
                "range images of {}x{} between {:g} and {:g} m".format(*kind),
                "{}x{} between {:g} and {:g} m, as the images before".format(*known),
                "project both sets with one sensor",
            )
        self._kind = known


def kind_of(sensor: SensorModel) -> Kind:
    """Return what images must have in common to be compared."""
    return sensor.height, sensor.width, sensor.range_min_m, sensor.range_max_m

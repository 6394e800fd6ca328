"""Range images → what a network sees of them, for metrics that compare two sets of features."""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from lidargrit.errors import ConfigError, DataError
from lidargrit.metrics import Metric
from lidargrit.metrics._networks.network import load_network
from lidargrit.metrics._networks.rangenet import WIDTH_STEP
from lidargrit.projection import points_of_pixels
from lidargrit.reporting import Reporter
from lidargrit.structures import RangeImage

_NEAREST_M, _FARTHEST_M = 0.5, 63.0  # of LiDARGen, whose encoding of range ends at 63 m
_R2DM_UNIT_M = 80.0  # whatever the sensor: its limit on KITTI-360
# Range, x, y, z and reflectance of SemanticKITTI, from darknet53-1024px.yaml of PRBonn/lidar-bonnetal.
_MEANS, _DEVIATIONS = (12.12, 10.88, 0.23, -1.04, 0.21), (12.32, 11.47, 6.91, 0.86, 0.16)


class FeatureMetric(Metric):
    """Looks at both sets through a network that others have trained, and compares the two clouds of features.

    Args:
        variant: which definition is used.
        seed: of all that the metric draws.
        weights: the file with the network's weights; found or fetched if not given.
        device: where the network computes, such as "cuda".
        reporter: hears of a download.

    Raises:
        WeightsError: no weights, or not those of the network.
        ConfigError: images of two sizes or two pairs of range limits, or merged parts that used other weights.
    """

    higher_is_better = False

    def __init__(
        self,
        *,
        variant: str | None = None,
        seed: int = 0,
        weights: Path | None = None,
        device: str = "cpu",
        reporter: Reporter | None = None,
    ) -> None:
        super().__init__(variant=variant, seed=seed)
        self.network = load_network(self.needs_weights, weights, device, reporter)
        self._images = {False: 0, True: 0}
        self._kind: tuple[int, int, float, float] | None = None  # rows, columns, shortest and longest range

    @abstractmethod
    def inputs(self, images: RangeImage) -> Float[Tensor, "B ..."]:
        """Turn a batch of images into what the network takes."""

    @abstractmethod
    def take(self, features: Float32[np.ndarray, "B d"], real: bool) -> None:
        """Take in the features of a batch."""

    @abstractmethod
    def take_from(self, other: FeatureMetric) -> None:
        """Take in the features that another process has gathered."""

    @torch.no_grad()
    def update(self, images: RangeImage, *, real: bool) -> None:
        """Show a batch of images to the network."""
        sensor = images.sensor
        images = images if images.range_m.ndim == 3 else RangeImage.stack([images])
        self._require_kind((sensor.height, sensor.width, sensor.range_min_m, sensor.range_max_m))
        if len(images):
            self.take(self.network.features(self.inputs(images)), real)
            self._images[real] += len(images)

    def merge(self, other: Metric) -> None:
        """Take in what another process has gathered."""
        self.require_same_options(other)
        assert isinstance(other, FeatureMetric)
        if other.network.sha256 != self.network.sha256:
            raise ConfigError(
                f"features through other weights ({other.network.path}) to merge",
                f"those through {self.network.path}",
                "give every process the same file",
            )
        if other._kind is not None:
            self._require_kind(other._kind)
            self.take_from(other)
            for real, count in other._images.items():
                self._images[real] += count

    def common_details(self) -> dict[str, Any]:
        """Return what identifies the weights, for a result's details."""
        return {"weights": {"file": self.network.path.name, "sha256": self.network.sha256}}

    def _require_kind(self, kind: tuple[int, int, float, float]) -> None:
        self._kind = self._kind or kind
        if self._kind != kind:
            raise ConfigError(
                "range images of {}x{} between {:g} and {:g} m".format(*kind),
                "{}x{} between {:g} and {:g} m, as the images before".format(*self._kind),
                "project both sets with one sensor",
            )


def unit_clouds(images: RangeImage, variant: str) -> Float[Tensor, "B 3 n"]:
    """Return the cloud of every image in units of the longest range: what PointNet sees.

    Args:
        images: a batch.
        variant: ``lidargrit`` places dropped pixels at the origin, divides by the sensor's longest range, and on
            KITTI-360 sensors takes what is not between 0.5 and 63 m for dropped; ``r2dm`` does so on all sensors and
            divides by 80 m; ``exact`` takes all returns and nothing else. The network takes the largest value over
            all points, so there a dropped pixel repeats a return; an image without any is one point at the origin.
    """
    sensor = images.sensor
    if variant == "r2dm" or (variant == "lidargrit" and "kitti_360" in sensor.name):
        images = between_limits(images)
    unit_m = _R2DM_UNIT_M if variant == "r2dm" else sensor.range_max_m
    clouds = (points_of_pixels(images) / unit_m).flatten(1, 2)  # (B, n, 3)
    if variant == "exact":
        returned = images.return_mask.flatten(1)
        first = returned.int().argmax(dim=1)
        clouds = torch.where(returned[..., None], clouds, clouds[torch.arange(len(clouds)), first][:, None])
    return clouds.mT


def normalised_images(images: RangeImage, variant: str) -> Float[Tensor, "B 5 H W"]:
    """Return range, x, y, z and reflectance as RangeNet++ has learnt them: by mean and deviation, 0 where dropped.

    Args:
        images: a batch, with reflectance.
        variant: ``r2dm`` takes what is not between 0.5 and 63 m for dropped; ``exact`` takes all returns.

    Raises:
        DataError: images without reflectance.
        ConfigError: a number of columns that cannot be halved five times.
    """
    if images.reflectance is None:
        raise DataError(
            "range images without reflectance",
            "reflectance at every return: RangeNet++ has learnt from it",
            "leave out frechet_range_distance and kernel_range_distance, or generate reflectance too",
        )
    if images.sensor.width % WIDTH_STEP:
        raise ConfigError(
            f"range images of {images.sensor.width} columns for RangeNet++",
            f"a multiple of {WIDTH_STEP}",
            "project with another number of columns: sensor.with_columns(...)",
        )
    reflectance = images.reflectance
    if variant == "r2dm":
        images = between_limits(images)
    channels = torch.cat((images.range_m[..., None], points_of_pixels(images), reflectance[..., None]), dim=-1)
    normalised = (channels - channels.new_tensor(_MEANS)) / channels.new_tensor(_DEVIATIONS)
    return (normalised * images.return_mask[..., None]).permute(0, 3, 1, 2)


def between_limits(images: RangeImage) -> RangeImage:
    """Drop what is not strictly between 0.5 and 63 m; reflectance is left out.

    Source:
        kazuto1011/r2dm@ad66e71, evaluate.py, after LiDARGen.
    """
    inside = (images.range_m > _NEAREST_M) & (images.range_m < _FARTHEST_M)
    return RangeImage.masked(images.range_m, images.return_mask & inside, images.sensor)

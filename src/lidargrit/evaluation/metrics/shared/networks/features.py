"""Range images → the features that a pretrained network finds in them, for metrics that compare two sets of these."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from lidargrit.core.errors import ConfigError, DataError
from lidargrit.evaluation.metrics import FeatureExtractor, Metric
from lidargrit.evaluation.metrics.shared.accumulators import Kept
from lidargrit.evaluation.metrics.shared.networks.network import PretrainedNetwork, load_network
from lidargrit.evaluation.metrics.shared.networks.pointnet import POINTNET_WEIGHTS
from lidargrit.evaluation.metrics.shared.networks.rangenet import WIDTH_STEP
from lidargrit.scans.projection import points_of_pixels
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage

_LIDARGEN_WINDOW_M = 0.5, 63.0  # its encoding of range ends at 63 m
_R2DM_UNIT_M = 80.0  # whatever the sensor: its limit on KITTI-360
# Range, x, y, z and reflectance of SemanticKITTI, from darknet53-1024px.yaml of PRBonn/lidar-bonnetal.
_MEANS, _DEVIATIONS = (12.12, 10.88, 0.23, -1.04, 0.21), (12.32, 11.47, 6.91, 0.86, 0.16)


@dataclass(frozen=True)
class UnitClouds:
    """Inputs of PointNet: the cloud of every image, with all coordinates divided by one unit.

    Args:
        unit_m: length that becomes 1, in metres.
        window_m: open interval of range in metres, outside which a return counts as dropped; None keeps all.
        returns_only: whether dropped pixels have no influence: each then repeats a return of its image, which changes
            nothing, since the network takes the largest value over all points. Otherwise each is a point at the origin,
            as is an image without any return.
    """

    unit_m: float
    window_m: tuple[float, float] | None
    returns_only: bool

    @classmethod
    def of(cls, variant: str, sensor: SensorModel) -> "UnitClouds":
        """Return the inputs of a published definition for images of a sensor.

        Args:
            variant: ``lidargrit`` divides by the sensor's longest range, and on KITTI-360 sensors takes what is not
                between 0.5 and 63 m for dropped; ``r2dm`` does so on all sensors and divides by 80 m; both keep dropped
                pixels as points at the origin. ``exact`` takes all returns and nothing else.
        """
        if variant == "r2dm":
            return cls(_R2DM_UNIT_M, _LIDARGEN_WINDOW_M, False)
        windowed = variant == "lidargrit" and "kitti_360" in sensor.name
        return cls(sensor.range_max_m, _LIDARGEN_WINDOW_M if windowed else None, variant == "exact")

    def __call__(self, images: RangeImage) -> Float[Tensor, "B 3 n"]:
        """Return the clouds of a batch."""
        images = within(images, self.window_m)
        clouds = (points_of_pixels(images) / self.unit_m).flatten(1, 2)  # (B, n, 3)
        if self.returns_only:
            returned = images.return_mask.flatten(1)
            first = returned.int().argmax(dim=1)
            clouds = torch.where(returned[..., None], clouds, clouds[torch.arange(len(clouds)), first][:, None])
        return clouds.mT


@dataclass(frozen=True)
class NormalisedImages:
    """Inputs of RangeNet++: range, x, y, z and reflectance by the mean and deviation of its training, 0 where dropped.

    Args:
        window_m: open interval of range in metres, outside which a return counts as dropped; None keeps all.
    """

    window_m: tuple[float, float] | None

    @classmethod
    def of(cls, variant: str) -> "NormalisedImages":
        """Return the inputs of a published definition: ``r2dm`` keeps 0.5 to 63 m, ``exact`` takes all returns."""
        return cls(_LIDARGEN_WINDOW_M if variant == "r2dm" else None)

    def __call__(self, images: RangeImage) -> Float[Tensor, "B 5 H W"]:
        """Return the channels of a batch."""
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
        images = within(images, self.window_m)
        channels = torch.cat((images.range_m[..., None], points_of_pixels(images), reflectance[..., None]), dim=-1)
        normalised = (channels - channels.new_tensor(_MEANS)) / channels.new_tensor(_DEVIATIONS)
        return (normalised * images.return_mask[..., None]).permute(0, 3, 1, 2)


@dataclass(frozen=True)
class NetworkFeatures(FeatureExtractor[Float32[np.ndarray, "B d"]]):
    """The features that a pretrained network finds in images."""

    network: PretrainedNetwork
    inputs: UnitClouds | NormalisedImages

    def __call__(self, images: RangeImage) -> Float32[np.ndarray, "B d"]:
        """Return the features of a batch."""
        return self.network.features(self.inputs(images))


class FeatureMetric(Metric[Float32[np.ndarray, "B d"], Kept]):
    """Compares the features that a pretrained network finds in two sets of images.

    Args:
        variant: the published definition to compute; the first of ``variants`` if not given.
    """

    def __init__(
        self, *, variant: str | None = None, seed: int = 0, weights: Path | None = None, device: str = "cpu"
    ) -> None:
        super().__init__(variant=variant, seed=seed)
        self.network = load_network(self.needs_weights, weights, device)

    @property
    def weights_sha256(self) -> str:
        """Hash of the file of the network's weights."""
        return self.network.sha256

    @final
    def extractor(self, sensor: SensorModel) -> NetworkFeatures:
        """Return the network with the inputs of the variant."""
        pointnet = self.needs_weights == POINTNET_WEIGHTS.name
        inputs = UnitClouds.of(self.variant, sensor) if pointnet else NormalisedImages.of(self.variant)
        return NetworkFeatures(self.network, inputs)

    @final
    def summarise(self, features: Float32[np.ndarray, "B d"], *, real: bool) -> np.ndarray:
        """Return the features themselves."""
        return features

    @final
    def options(self) -> str:
        """Return what metrics must have in common to be merged, the weights among it."""
        return f"{super().options()} through weights of SHA-256 {self.weights_sha256}"

    def weights_details(self) -> dict[str, Any]:
        """Return what identifies the weights, for the details of a result."""
        return {"weights": {"file": self.network.path.name, "sha256": self.weights_sha256}}


def within(images: RangeImage, window_m: tuple[float, float] | None) -> RangeImage:
    """Drop returns that are not strictly inside a window of range; reflectance is left out.

    Source:
        kazuto1011/r2dm@ad66e71, evaluate.py, after LiDARGen.
    """
    if window_m is None:
        return images
    inside = (images.range_m > window_m[0]) & (images.range_m < window_m[1])
    return RangeImage.masked(images.range_m, images.return_mask & inside, images.sensor)

"""A segmenter: scans → the class of every return, by SemanticKITTI's numbers."""

from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from lidargrit.core.configuration import Settings
from lidargrit.core.typed_values import Count, NotNegative
from lidargrit.generation.batches import check_images, one_by_one
from lidargrit.generation.facts import Cost, SamplingSettings, SystemFacts
from lidargrit.generation.generator import Generator
from lidargrit.generation.objective import Objective, hidden_in_some
from lidargrit.generation.reflectance import TYPICAL_REFLECTANCE, required_reflectance
from lidargrit.generation.semantic_classes import NUM_CLASSES, class_indices, class_iou, labels_to_learn
from lidargrit.nn.flops import FlopCounter
from lidargrit.nn.precision import inference
from lidargrit.nn.small_unet import Part, SmallUnet, SmallUnetConfig, check_size
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import TYPICAL_LOG_RANGE, RangeImage

_NUM_MAPS = 4
_HEIGHT_M = 3.0  # the scale of heights: what stands on the ground is about so high
_HEIGHTS_AT_MOST = 4.0  # times that
_BEND, _BEND_STEPS = 0.005, 3.0  # a small bend relative to inverse range; scale of the logarithm of bends


@dataclass(frozen=True)
class SegmenterNetworkConfig(SmallUnetConfig):
    """Sizes of the segmenter's network, those of its U-Net among them, and what it sees.

    Args:
        reflectance: whether the network sees the reflectance of returns, where scans have it.
        bends: whether it sees how inverse range bends from each return's neighbour on the left to that on the right:
            not at all on a plane at whatever range, so that leaves do not look like walls.
    """

    widths: tuple[Count, Count, Count] = (32, 64, 96)
    blocks: Count = 2
    attention_layers: NotNegative = 1
    heads: Count = 4
    reflectance: bool = True
    bends: bool = False


class SegmenterNetwork(nn.Module):
    """A small U-Net over the returns of a scan: range, height above the sensor, and elevation of every pixel.

    Source:
        the inputs of Milioto et al., RangeNet++, IROS 2019, without x and y, which tell where the scan turns.
    """

    def __init__(self, config: SegmenterNetworkConfig, sensor: SensorModel) -> None:
        super().__init__()
        check_size(sensor.height, sensor.width, "a segmenter")
        self.config = config
        self.register_buffer("elevation_rad", sensor.elevation_rad.double().mean(1).float(), persistent=False)
        parts = {"reflectance": Part(2, 0)} if config.reflectance else {}
        self.unet = SmallUnet(config, _NUM_MAPS + config.bends, NUM_CLASSES, parts)

    elevation_rad: Tensor

    def forward(
        self, range_m: Float[Tensor, "B H W"], reflectance: Float[Tensor, "B H W"] | None = None
    ) -> Float[Tensor, "B 19 H W"]:
        """Return a logit for each of the benchmark's classes at every pixel.

        Args:
            reflectance: reflectance of the returns, NaN where it is not known; None if it is known of none.
        """
        more = dict[str, Tensor]()
        if self.config.reflectance:
            known = torch.zeros_like(range_m) if reflectance is None else reflectance.isfinite().to(range_m.dtype)
            value = torch.zeros_like(range_m) if reflectance is None else reflectance - TYPICAL_REFLECTANCE
            more["reflectance"] = torch.stack((known, torch.where(known > 0, value, 0.0)), 1)
        logits, _ = self.unet(self._maps(range_m), more)
        return logits.float()

    def _maps(self, range_m: Float[Tensor, "B H W"]) -> Float[Tensor, "B C H W"]:
        """Return maps of returns, their ranges and heights, the elevations of the rays, and bends if wanted."""
        returned = range_m > 0
        elevation = self.elevation_rad[:, None].expand_as(range_m)
        height = (range_m * elevation.sin() / _HEIGHT_M).clamp(-_HEIGHTS_AT_MOST, _HEIGHTS_AT_MOST)
        near = torch.where(returned, range_m.log1p() - TYPICAL_LOG_RANGE, 0.0)
        maps = [returned.to(range_m.dtype), near, height, 5 * elevation]
        if self.config.bends:
            maps.append(bends_across_columns(range_m))
        return torch.stack(maps, 1)


def bends_across_columns(range_m: Float[Tensor, "B H W"]) -> Float[Tensor, "B H W"]:
    """Return how inverse range bends at each return, relative to itself and in logarithmic steps of both signs.

    On a plane the inverse range is a cosine of the azimuth, so it hardly bends at all. The last column is beside the
    first one; a return without both neighbours has 0.
    """
    inverse = torch.where(range_m > 0, 1 / range_m, 0.0)
    left, right = inverse.roll(1, 2), inverse.roll(-1, 2)
    known = (inverse > 0) & (left > 0) & (right > 0)
    bend = torch.where(known, range_m * (left + right) / 2 - 1, 0.0)
    return bend.sign() * (bend.abs() / _BEND).log1p() / _BEND_STEPS


_SETTING = "model.segmenter.reflectance"
_WITHOUT_REFLECTANCE = 0.5  # of the scans: generated ones often have none
_NOISE_M = 0.05  # largest standard deviation of noise added in training, so that clean ranges are known, too


class SegmenterObjective(Objective):
    """The cross-entropy of the classes of returns; a class counts by the square root of its share of them."""

    additions = frozenset({"reflectance"})

    def __init__(self, network: SegmenterNetwork, sensor: SensorModel) -> None:
        super().__init__(sensor)
        self.segmenter = network

    def check(self, images: RangeImage) -> None:
        """Refuse images without labels, or without the reflectance that the network is to see."""
        labels_to_learn(images.label)
        if self.segmenter.config.reflectance:
            required_reflectance(images.reflectance, _SETTING)

    def forward(self, example: Example, rng: torch.Generator, player: str = "") -> dict[str, Tensor]:
        """Return the loss, and beside it the share of returns whose class it finds, and the mean over classes of the
        intersection over the union.
        """
        images = example.images
        range_m, reflectance = images.range_m, None
        if self.segmenter.config.reflectance:
            reflectance = required_reflectance(images.reflectance, _SETTING)
            reflectance = hidden_in_some(reflectance, torch.nan, _WITHOUT_REFLECTANCE, rng)
        if self.training:
            noise = torch.randn(range_m.shape, generator=rng, device=rng.device)
            most = torch.rand((len(range_m), 1, 1), generator=rng, device=rng.device) * _NOISE_M
            noisy = (range_m + noise * most).clamp(min=self.sensor.range_min_m)
            range_m = torch.where(images.return_mask, noisy, 0.0)
        wanted = torch.where(images.return_mask, class_indices(labels_to_learn(images.label)), 0)
        logits = self.segmenter(range_m, reflectance)
        counts = pair_counts(logits.detach(), wanted)
        of_class = counts[1:].sum(1)
        weight = torch.where(of_class > 0, of_class.clamp(min=1).rsqrt(), 0.0)
        loss = F.cross_entropy(logits, wanted - 1, weight, ignore_index=-1)  # 0, no class, becomes -1
        loss = loss.where(of_class.any(), 0.0)  # scans without a label teach nothing, and have no mean
        accuracy = counts.diagonal()[1:].sum() / of_class.sum().clamp(min=1)
        mean_iou = class_iou(counts).nan_to_num().sum() / (of_class > 0).sum().clamp(min=1)
        return {"loss": loss, "accuracy": accuracy, "mean_iou": mean_iou}


def pair_counts(logits: Float[Tensor, "B 19 H W"], wanted: Int[Tensor, "B H W"]) -> Float[Tensor, "20 20"]:
    """Count the pixels of each true class (rows) and found class (columns); the first of each is no class.

    Args:
        wanted: true class, from 1 to 19; 0 where it is not known.
    """
    size = NUM_CLASSES + 1
    pairs = (wanted * size + logits.argmax(1) + 1).flatten()
    return logits.new_zeros(size**2).scatter_add(0, pairs, logits.new_ones(len(pairs))).view(size, size)


@dataclass(frozen=True)
class SegmenterConfig(Settings):
    """The network, which is the whole system."""

    segmenter: SegmenterNetworkConfig = field(default_factory=SegmenterNetworkConfig)


class Segmenter(Generator[SegmenterConfig, SamplingSettings]):
    """A network that tells of every return which of the 19 classes of SemanticKITTI's benchmark it is."""

    Config = SegmenterConfig
    trains = (("segmenter", "segmenter"),)
    facts = SystemFacts(
        generates="a label for every return of a scan; no scans", first_command="segment SCANS labelled --model RUN"
    )
    is_random = False
    has_new_scans = False

    def __init__(self, config: SegmenterConfig, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        self.segmenter = SegmenterNetwork(config.segmenter, sensor)

    @classmethod
    def smallest_config(cls, sensor: SensorModel) -> SegmenterConfig:
        """Return a network of eight channels and one block."""
        return SegmenterConfig(SegmenterNetworkConfig((8, 8, 8), blocks=1, attention_layers=0, heads=1))

    def objective(self, stage: str) -> Objective:
        """Return the errors of the classes."""
        return SegmenterObjective(self.segmenter, self.sensor)

    @inference()
    def probabilities(self, images: RangeImage) -> Float[Tensor, "B 19 H W"]:
        """Return the probability of each of the benchmark's classes at every pixel, on the generator's device.

        Args:
            images: batch of range images (B, H, W), each computed by itself.
        """
        check_images(images, self.sensor)
        self.eval()
        each = one_by_one(images.to(self.device))
        return torch.cat([self.segmenter(image.range_m, image.reflectance).softmax(1) for image in each])

    def cost(self, sampling: SamplingSettings | None = None) -> Cost:
        """Return the cost of labelling one scan, counted while it is computed."""
        with torch.no_grad(), FlopCounter() as counter:
            self.segmenter(torch.zeros(1, self.sensor.height, self.sensor.width, device=self.device))
        return Cost(1, counter.total)

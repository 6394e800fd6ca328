"""What trains a segmenter: labelled scans → the terms of a loss."""

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from lidargrit.generation.objective import Objective, hidden_in_some
from lidargrit.generation.reflectance import required_reflectance
from lidargrit.generation.semantic_classes import NUM_CLASSES, class_indices, labels_to_learn
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage
from lidargrit.systems.segmenter.network import SegmenterNetwork

_SETTING = "model.segmenter.reflectance"
_WITHOUT_REFLECTANCE = 0.5  # of the scans: generated ones often have none
_NOISE_M = 0.05  # largest standard deviation of noise added in training, so that clean ranges are known, too


class SegmenterObjective(Objective):
    """The cross-entropy of the classes of returns; a class counts by the square root of its share of them.

    Args:
        network: network that is trained.
        sensor: sensor whose scans it labels.
    """

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
        of_class = counts.sum(0)
        weight = torch.where(of_class > 0, of_class.clamp(min=1).rsqrt(), 0.0)
        loss = F.cross_entropy(logits, wanted - 1, weight, ignore_index=-1)  # 0, no class, becomes -1
        right = counts.diagonal()
        iou = right / (counts.sum(1) + of_class - right).clamp(min=1)
        mean_iou = iou.where(of_class > 0, 0).sum() / (of_class > 0).sum().clamp(min=1)
        return {"loss": loss, "accuracy": right.sum() / of_class.sum().clamp(min=1), "mean_iou": mean_iou}


def pair_counts(logits: Float[Tensor, "B 19 H W"], wanted: Int[Tensor, "B H W"]) -> Float[Tensor, "19 19"]:
    """Count the pixels of each found class (rows) and true class (columns), of those whose true class is known.

    Args:
        wanted: true class, from 1 to 19; 0 where it is not known.
    """
    pairs = (logits.argmax(1) * (NUM_CLASSES + 1) + wanted).flatten()
    counts = logits.new_zeros(NUM_CLASSES * (NUM_CLASSES + 1)).scatter_add(0, pairs, logits.new_ones(len(pairs)))
    return counts.view(NUM_CLASSES, NUM_CLASSES + 1)[:, 1:]

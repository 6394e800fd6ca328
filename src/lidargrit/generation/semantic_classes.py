"""The classes that networks learn, those of SemanticKITTI's benchmark: numbers of labels ⇄ indices and channels."""

from typing import Final

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor, nn

from lidargrit.core.errors import ConfigError
from lidargrit.scans.classes import CLASSES, LEARNED

NUM_CLASSES: Final = len(LEARNED)
# 0 for labels of no class, such as those that are not known; the last stands for all numbers from there on.
_INDEX = torch.zeros(max(CLASSES) + 2, dtype=torch.int64)
for _number, _class in CLASSES.items():
    _INDEX[_number] = LEARNED.index(_class.learned) + 1 if _class.learned else 0
_NUMBER = torch.tensor([0, *LEARNED])


def class_indices(label: Int[Tensor, "*B"]) -> Int[Tensor, "*B"]:
    """Return the class of each label, from 1 to 19; 0 for labels of no class."""
    return _INDEX.to(label.device)[label.clamp(0, len(_INDEX) - 1)]


def labels_of(indices: Int[Tensor, "*B"]) -> Int[Tensor, "*B"]:
    """Return the label that is written for each class, by SemanticKITTI's numbers; 0 for the class 0."""
    return _NUMBER.to(indices.device)[indices]


class ClassMaps(nn.Module):
    """Labels of pixels → a few learned channels for each, all of them 0 where the class is not known.

    Args:
        channels: number of channels of a label.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.embedding = nn.Embedding(NUM_CLASSES + 1, channels, padding_idx=0)

    def forward(self, indices: Int[Tensor, "B S H W"]) -> Float[Tensor, "B C H W"]:
        """Return the channels of all labels of a pixel, one label after the other."""
        return self.embedding(indices).permute(0, 1, 4, 2, 3).flatten(1, 2)


def votes(indices: Int[Tensor, "B S H W"], weights: Float[Tensor, "B S H W"]) -> Float[Tensor, "B 19 H W"]:
    """Return for each class the sum of the weights of the labels that are of this class."""
    size = (len(indices), NUM_CLASSES + 1, *indices.shape[2:])
    return weights.new_zeros(size).scatter_add(1, indices, weights)[:, 1:]


def class_iou(counts: Shaped[Tensor, "K K"]) -> Float[Tensor, "C"]:
    """Return the intersection over union of each class, in [0, 1]; NaN for classes of which there is nothing true.

    Args:
        counts: number of pixels or points by true class (rows) and found class (columns); the first of each is no
            class. What is truly of no class does not count; what is wrongly found to be of none does.
    """
    counts = counts[1:]
    right, true, found = counts[:, 1:].diagonal(), counts.sum(1), counts[:, 1:].sum(0)
    # Not indexed by a mask: the host would wait for the number of classes in it.
    return torch.where(true > 0, right / (true + found - right), torch.nan)


def labels_to_learn(label: Int[Tensor, "B H W"] | None) -> Int[Tensor, "B H W"]:
    """Return the labels of training scans; refuse scans without them, with ConfigError."""
    if label is None:
        raise ConfigError(
            "training scans without labels, for a network that learns them",
            "scans with labels, such as simulated:512:train",
            "name such scans, or prepare them anew; or leave out labels=true, if you set it",
        )
    return label

"""One batch of training examples: range images, and what a generator is told of each."""

from dataclasses import dataclass

import torch

from lidargrit.scans.condition import NOTHING, Condition
from lidargrit.scans.types import RangeImage


@dataclass(frozen=True, eq=False)
class Example:
    """A batch of range images with its condition.

    Args:
        images: batch of range images (B, H, W).
        condition: condition of each image, as many as images; or nothing.
    """

    images: RangeImage
    condition: Condition = NOTHING

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: slice | list[int]) -> "Example":
        """Return some of the examples."""
        return Example(self.images[index], self.condition[index])

    def to(self, device: torch.device | str) -> "Example":
        """Return the examples with their tensors on another device."""
        return Example(self.images.to(device), self.condition.to(device))

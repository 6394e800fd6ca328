"""One batch of training examples: range images, and what a generator is told of each."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from lidargrit.scans.condition import NOTHING, Condition
from lidargrit.scans.types import RangeImage


@dataclass(frozen=True, eq=False)
class Example:
    """A batch of range images with its condition.

    Args:
        images: batch of range images (B, H, W).
        condition: condition of each image, as many as images; or nothing.
        keys: key of each image, by which what is computed of it is known again; None where nothing is kept.
    """

    images: RangeImage
    condition: Condition = NOTHING
    keys: tuple[bytes, ...] | None = None

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: slice | list[int]) -> "Example":
        """Return some of the examples."""
        keys = self.keys
        if keys is not None:
            keys = keys[index] if isinstance(index, slice) else tuple(keys[number] for number in index)
        return Example(self.images[index], self.condition[index], keys)

    @classmethod
    def cat(cls, parts: "Sequence[Example]") -> "Example":
        """Return the examples of several batches, whose conditions are of one kind, as one, without keys."""
        conditions = [part.condition for part in parts]
        return cls(RangeImage.cat([part.images for part in parts]), type(conditions[0]).cat(conditions))

    def to(self, device: torch.device | str) -> "Example":
        """Return the examples with their tensors on another device."""
        return Example(self.images.to(device), self.condition.to(device), self.keys)

    def with_keys(self) -> "Example":
        """Return the examples with the keys of their images; those on a GPU are copied to the host for it."""
        return replace(self, keys=keys_of(self.images))


def keys_of(images: RangeImage) -> tuple[bytes, ...]:
    """Return a hash of the pixels of each image, so that an augmented image is another."""
    maps = [images.range_m] if images.reflectance is None else [images.range_m, images.reflectance]
    each = zip(*(one.cpu().numpy() for one in maps), strict=True)
    return tuple(hashlib.blake2b(b"".join(part.tobytes() for part in parts), digest_size=16).digest() for parts in each)

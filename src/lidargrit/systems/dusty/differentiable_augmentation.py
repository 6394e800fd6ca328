"""Changes that a discriminator sees on real and generated images alike, so that it cannot learn scans by heart."""

from collections.abc import Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

DifferentiableAugmentation = Literal["brightness", "contrast", "translation", "cutout"]

_STRENGTH = 0.5  # of brightness and contrast
_SHIFT = 1 / 16  # of rows and of columns, either way
_CUT = 0.5  # of rows and of columns


def augment_differentiably(
    images: Float[Tensor, "B 1 H W"], kinds: Sequence[DifferentiableAugmentation], rng: torch.Generator
) -> Float[Tensor, "B 1 H W"]:
    """Change every image of a batch at random, so that gradients flow through to it.

    Args:
        images: encoded range images in [-1, 1].
        kinds: ``brightness`` adds up to half; ``contrast`` scales the distance from the image's mean by 1/2 to 3/2;
            ``translation`` turns columns around the circle and shifts rows, with zeros coming in; ``cutout`` sets a
            window of half the rows and half the columns to zero, less where it reaches over an edge.
        rng: source of all randomness, on the images' device.

    Source:
        Zhao et al., Differentiable Augmentation for Data-Efficient GAN Training, 2020; kazuto1011/dusty-gan@0374a5e,
        utils/diff_augment.py, for the circle. That program squares the numbers of brightness and contrast, so that
        images only become brighter and steeper, and its circle is a column too short; neither is repeated here.
    """

    def random_change() -> Float[Tensor, "B 1 1 1"]:
        return torch.rand(len(images), 1, 1, 1, generator=rng, device=images.device) * 2 - 1

    for kind in kinds:
        if kind == "brightness":
            images = images + _STRENGTH * random_change()
        elif kind == "contrast":
            mean = images.mean(dim=(1, 2, 3), keepdim=True)
            images = mean + (images - mean) * (1 + _STRENGTH * random_change())
        elif kind == "translation":
            images = _translated(images, rng)
        else:
            images = _cut_out(images, rng)
    return images


def _translated(images: Tensor, rng: torch.Generator) -> Tensor:
    batch, _, height, width = images.shape
    rows, columns = (
        torch.arange(size, device=images.device) + _whole(-round(_SHIFT * size), round(_SHIFT * size), batch, rng)
        for size in (height, width)
    )
    rows = rows.clamp(-1, height) + 1  # of an image with a row of zeros above and below
    shifted = F.pad(images, (0, 0, 1, 1)).gather(2, rows[:, None, :, None].expand(-1, 1, -1, width))
    return shifted.gather(3, (columns % width)[:, None, None, :].expand(-1, 1, height, -1))


def _cut_out(images: Tensor, rng: torch.Generator) -> Tensor:
    inside: list[Tensor] = []
    for size in images.shape[-2:]:
        cut = round(_CUT * size)
        first = _whole(0, size, len(images), rng) - cut // 2
        pixel = torch.arange(size, device=images.device)
        inside.append((pixel >= first) & (pixel < first + cut))
    return images * ~(inside[0][:, None, :, None] & inside[1][:, None, None, :])


def _whole(low: int, high: int, count: int, rng: torch.Generator) -> Tensor:
    return torch.randint(low, high + 1, (count, 1), generator=rng, device=rng.device)

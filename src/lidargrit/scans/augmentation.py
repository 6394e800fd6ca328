"""Training examples → randomly changed ones: all planes of an image change together, and the past turns with it."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from lidargrit.core.errors import ConfigError
from lidargrit.scans.classes import CLASS_BITS, CLASSES
from lidargrit.scans.example import Example
from lidargrit.scans.past import Past
from lidargrit.scans.types import RangeImage

Augmentation = Literal["flip", "roll", "paste", "geometric", "geometric_reference"]

_THINGS = torch.tensor([number for number, each in CLASSES.items() if each.group in ("vehicle", "person, cycle")])

_MAX_ROTATION_RAD = math.radians(30)  # the program: random affine of up to 30 degrees, ...
_MAX_SHIFT = 0.1  # ... shifts of a tenth of the image, ...
_MAX_SCALE_CHANGE = 0.1  # ... and scales from 0.9 to 1.1
_EXTRA_ROTATION_RAD = math.radians(45)  # the program rotates by up to 45 degrees before that


def augment(
    example: Example,
    kinds: Sequence[Augmentation],
    rng: torch.Generator,
    another: Callable[[], RangeImage] | None = None,
) -> Example:
    """Change every example of a batch at random.

    Args:
        kinds: kinds of change, made one after the other. ``flip`` mirrors left and right with probability 1/2. ``roll``
            turns the scan about the vertical axis by a random number of columns. ``paste`` shows, with probability 1/2,
            also the vehicles, people and bicycles of another scan, turned at random, where they are nearer than what
            the scan itself shows, or where it has no return; both need labels. ``geometric`` is the paper's geometric
            preservation: with probability 1/2, an affine map and flips along both axes; pixels from outside the image
            are *no return*. ``geometric_reference`` is the same with the larger rotation of the authors' program, which
            fills such pixels with returns at the longest range.
        another: function that reads another batch of as many images of the same sensor, for ``paste``.

    Raises:
        ConfigError: another change than ``flip`` or ``roll`` of a scan with a past; or ``paste`` of scans without
            labels, or without ``another``.

    Source:
        Haghighi et al., LidarGRIT, 2024, section 3.2.2 (the paper gives no numbers); numbers from the program,
        hamedhaghighi/LidarGRIT@a3f86e7. ``paste``: Xiao et al., PolarMix, NeurIPS 2022, "instance-level rotate-paste",
        here once, on range images, and behind what hides it.
    """
    for kind in kinds:
        if kind == "flip":
            example = _flip(example, rng)
        elif kind == "roll":
            example = _roll(example, rng)
        elif isinstance(example.condition, Past):
            raise ConfigError(f"the augmentation {kind} of scans with a past", "flip or roll", "leave it out")
        elif kind == "paste":
            example = replace(example, images=_paste(example.images, another, rng))
        else:
            example = replace(example, images=_distort(example.images, rng, kind == "geometric_reference"))
    return example


def _coin(images: RangeImage, rng: torch.Generator) -> Tensor:
    return (torch.rand(len(images), generator=rng) < 0.5).to(images.range_m.device)[:, None, None]


def _flip(example: Example, rng: torch.Generator) -> Example:
    images, condition = example.images, example.condition
    flipped = _coin(images, rng)
    if isinstance(condition, Past):
        condition = condition.mirrored(flipped[:, 0, 0])
    return Example(_pick(flipped, images.mapped(lambda pixels: pixels.flip(-1)), images), condition)


def _roll(example: Example, rng: torch.Generator) -> Example:
    images, condition = example.images, example.condition
    width = images.range_m.shape[-1]
    shift = torch.randint(width, (len(images), 1, 1), generator=rng).to(images.range_m.device)
    column = ((torch.arange(width, device=shift.device) + shift) % width).expand_as(images.range_m)
    if isinstance(condition, Past):
        condition = condition.turned(shift[:, 0, 0] * images.sensor.column_stride)
    return Example(images.mapped(lambda pixels: pixels.gather(-1, column)), condition)


def _paste(images: RangeImage, another: Callable[[], RangeImage] | None, rng: torch.Generator) -> RangeImage:
    if images.label is None:
        raise ConfigError("the augmentation paste of scans without labels", "scans with labels", "leave it out")
    if another is None:
        raise ConfigError("the augmentation paste of scans alone", "other scans to paste from", "leave it out")
    chosen = _coin(images, rng)
    if not chosen.any():
        return images
    other = _roll(Example(another()), rng).images
    assert other.label is not None
    thing = torch.isin(other.label & CLASS_BITS, _THINGS.to(other.label.device)) & other.return_mask
    nearer = thing & (~images.return_mask | (other.range_m < images.range_m))
    return _pick(chosen & nearer, other, images)


def _distort(images: RangeImage, rng: torch.Generator, as_program: bool) -> RangeImage:
    batch, height, width = images.range_m.shape

    def uniform(limit: float) -> Tensor:
        return (torch.rand(batch, generator=rng) * 2 - 1) * limit

    angle = uniform(_MAX_ROTATION_RAD) + uniform(_EXTRA_ROTATION_RAD if as_program else 0.0)
    scale = 1 + uniform(_MAX_SCALE_CHANGE)
    flip_columns, flip_rows = ((torch.rand(batch, generator=rng) < 0.5) * -2.0 + 1 for _ in range(2))
    cos, sin = angle.cos() / scale, angle.sin() / scale
    # A rotation keeps shapes in pixels, but affine_grid counts in halves of the image: hence the ratio of its sides.
    matrix = torch.stack(
        (
            torch.stack((flip_columns * cos, flip_columns * -sin * height / width, uniform(2 * _MAX_SHIFT)), 1),
            torch.stack((flip_rows * sin * width / height, flip_rows * cos, uniform(2 * _MAX_SHIFT)), 1),
        ),
        1,
    ).to(images.range_m.device)
    grid = F.affine_grid(matrix, [batch, 1, height, width], align_corners=False)

    def warp(pixels: Float[Tensor, "B H W"]) -> Float[Tensor, "B H W"]:
        return F.grid_sample(pixels[:, None], grid, mode="nearest", padding_mode="zeros", align_corners=False)[:, 0]

    warped = images.mapped(lambda pixels: warp(pixels.float()).to(pixels.dtype))
    if as_program:
        outside = warp(torch.ones_like(images.range_m)) == 0
        range_m = torch.where(outside, images.sensor.range_max_m, warped.range_m)
        warped = replace(warped, range_m=range_m, return_mask=warped.return_mask | outside)
    return _pick(_coin(images, rng), warped, images)


def _pick(chosen: Tensor, changed: RangeImage, images: RangeImage) -> RangeImage:
    return replace(
        images,
        range_m=torch.where(chosen, changed.range_m, images.range_m),
        return_mask=torch.where(chosen, changed.return_mask, images.return_mask),
        planes={name: torch.where(chosen, changed.planes[name], pixels) for name, pixels in images.planes.items()},
    )

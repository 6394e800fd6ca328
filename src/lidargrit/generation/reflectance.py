"""Reflectance in networks that take range images: what they learn from, and how far an estimate is off."""

from typing import Final

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidargrit.core.errors import ConfigError
from lidargrit.scans.types import RangeImage

TYPICAL_REFLECTANCE: Final = 0.25  # of roads and walls in KITTI; what a network begins with, and 0 among its inputs


def required_reflectance(reflectance: Float[Tensor, "*B H W"] | None, setting: str) -> Float[Tensor, "*B H W"]:
    """Return the reflectance of scans; refuse scans without it, with ConfigError.

    Args:
        setting: name of the setting by which a network takes it, for the message.
    """
    if reflectance is None:
        raise ConfigError(
            f"scans without reflectance, for a model of {setting}=true",
            "scans that have it",
            f"name or prepare scans with reflectance, or train with --set {setting}=false",
        )
    return reflectance


def reflectance_of_returns(images: RangeImage) -> Float[Tensor, "*B H W"]:
    """Return the reflectance of images as :func:`required_reflectance` does, and 0 where none of them has a return."""
    if images.reflectance is None and not bool(images.return_mask.any()):
        return torch.zeros_like(images.range_m)
    return required_reflectance(images.reflectance, "model.reflectance")


def reflectance_error(
    found: Float[Tensor, "B H W"], true: Float[Tensor, "B H W"], counted: Bool[Tensor, "B H W"]
) -> Float[Tensor, " B"]:
    """Return the mean absolute error of each scan over the counted pixels; 0 where none is."""
    return ((found - true).abs() * counted).sum((1, 2)) / counted.sum((1, 2)).clamp(min=1)

"""What a range image may know of every pixel beside its range: the name of a plane → its type."""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lidargrit.core.errors import ConfigError


class Plane(NamedTuple):
    """What a plane of a range image holds for every pixel, beside its range.

    Args:
        dtype: type in which images of data have them; those of floating point are always kept in it.
        of_returns: whether only a return has one; it is 0 elsewhere.
    """

    dtype: type[np.float32 | np.int64]
    of_returns: bool


PLANES: Final[Mapping[str, Plane]] = MappingProxyType(
    {
        "reflectance": Plane(np.float32, of_returns=True),  # in [0, 1]
        "label": Plane(np.int64, of_returns=True),  # class by SemanticKITTI's numbers, without instance; 0: not known
    }
)
"""What a range image may know of every pixel beside its range, by name."""

NO_PLANES: Final[Mapping[str, Tensor]] = MappingProxyType({})


def planes_of(**known: Tensor | None) -> dict[str, Tensor]:
    """Return the planes among some of :data:`PLANES`, each None where it is not known."""
    return {name: pixels for name, pixels in known.items() if pixels is not None}


def common_planes(parts: Sequence[Mapping[str, Tensor]], join: Callable[[list[Tensor]], Tensor]) -> dict[str, Tensor]:
    """Join those planes that every part has."""
    return {name: join([part[name] for part in parts]) for name in parts[0] if all(name in part for part in parts)}


def checked_planes(planes: Mapping[str, Tensor], shape: torch.Size) -> dict[str, Tensor]:
    """Return planes in the types that they are kept in, or raise ConfigError where one has another name or shape."""
    for name, pixels in planes.items():
        if name not in PLANES:
            raise ConfigError(f"a plane {name!r}", f"one of {', '.join(PLANES)}", "name it so")
        if pixels.shape != shape:
            got, wanted = f"{name} of {tuple(pixels.shape)}", f"the {tuple(shape)} of range_m"
            raise ConfigError(got, wanted, "give all one shape")
        if PLANES[name].dtype is np.int64 and (pixels.is_floating_point() or pixels.dtype == torch.bool):
            raise ConfigError(f"{name} of type {pixels.dtype}", "whole numbers", "make them of type torch.int32")
    return {name: pixels.float() if PLANES[name].dtype is np.float32 else pixels for name, pixels in planes.items()}


def masked_planes(planes: Mapping[str, Tensor], return_mask: Tensor) -> dict[str, Tensor]:
    """Return planes in which those of returns are 0 where nothing returned."""
    return {
        name: torch.where(return_mask, pixels, 0) if PLANES[name].of_returns else pixels
        for name, pixels in planes.items()
    }

"""Weights in 8 bits: numbers ⇄ whole numbers and the scale of every 64 of them."""

from collections.abc import Iterable, Mapping
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import BFloat16, Float, Int8
from torch import Tensor

WeightBits = Literal[8, 16, 32]
"""Bits of a stored weight: quantized, half precision, or single precision."""

_BLOCK = 64  # numbers that share a scale, as they follow one another in the tensor
_LARGEST = 127
_SCALES = ":scales"  # after a tensor's name; no module can have a parameter of such a name by accident


def quantize(weight: Float[Tensor, "*size"]) -> tuple[Int8[Tensor, "*size"], BFloat16[Tensor, "blocks"]]:
    """Return whole numbers from -127 to 127, and what those of each block are multiplied with.

    A scale has 8 significant bits, so a product with it is exact in 32 bits, and quantizing the products again gives
    the same numbers: what was measured with rounded weights holds for the file.

    Source:
        Dettmers et al., 8-bit Optimizers via Block-wise Quantization, 2022, section 2.1; there with a table of uneven
        steps, here with even ones.
    """
    numbers = weight.detach().float().flatten()
    blocks = F.pad(numbers, (0, -len(numbers) % _BLOCK)).view(-1, _BLOCK)
    scales = (blocks.abs().amax(1) / _LARGEST).bfloat16()
    steps = blocks / scales.float().clamp(min=torch.finfo(torch.float32).tiny)[:, None]
    whole = steps.round().clamp(-_LARGEST, _LARGEST).to(torch.int8)
    return whole.flatten()[: len(numbers)].view(weight.shape), scales


def with_quantized(weights: Mapping[str, Tensor], names: Iterable[str]) -> dict[str, Tensor]:
    """Return the weights of a file in which tensors of these names have 8 bits; their scales stand beside them."""
    found = dict(weights)
    for name in names:
        found[name], found[name + _SCALES] = quantize(weights[name])
    return found


def without_quantized(stored: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the weights of a file, those of 8 bits multiplied with their scales, which are left out.

    Scales that belong to no such tensor stay, so that whoever looks for the weights of a network names them.
    """
    found = dict(stored)
    for name, whole in stored.items():
        scales = stored.get(name + _SCALES)
        blocks = -(-whole.numel() // _BLOCK)
        if whole.dtype == torch.int8 and scales is not None and scales.shape == (blocks,):
            each = scales.float().repeat_interleave(_BLOCK)[: whole.numel()].view(whole.shape)
            found[name] = whole.float() * each
            del found[name + _SCALES]
    return found

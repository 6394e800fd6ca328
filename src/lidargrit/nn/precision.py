"""The number type that a network computes in: 32 bits, or 16 where the machine has instructions for them."""

from contextlib import AbstractContextManager
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

Precision = Literal["fp32", "bf16", "auto"]


def has_bf16() -> bool:
    """Return whether this machine computes in bfloat16 natively."""
    if torch.cuda.is_available():
        return torch.cuda.is_bf16_supported(including_emulation=False)
    # Torch has no public question for this yet; a torch without this one is taken for a machine without bfloat16.
    return bool(getattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)())


def at_least_32_bits(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return numbers in 32 bits, or in 64 if they have as many: for what 16 bits cannot tell."""
    return x.to(torch.promote_types(x.dtype, torch.float32))


def without_autocast(device: torch.device) -> AbstractContextManager[object]:
    """Compute in the numbers' own precision within the ``with`` block, whatever the training has chosen around it."""
    return torch.autocast("cpu" if device.type == "meta" else device.type, enabled=False)


def autocast_to(precision: Precision, device: torch.device) -> AbstractContextManager[object]:
    """Compute products and convolutions within the ``with`` block in a precision; outputs may have 16 bits."""
    return torch.autocast(device.type, torch.bfloat16, enabled=dtype_of(precision) == torch.bfloat16)


def dtype_of(precision: Precision) -> torch.dtype:
    """Return the type of a precision's numbers; ``auto`` is bf16 where the machine has instructions for it."""
    return torch.bfloat16 if precision == "bf16" or (precision == "auto" and has_bf16()) else torch.float32

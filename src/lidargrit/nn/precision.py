"""The number type that a network computes in: 32 bits, or 16 where the machine has instructions for them."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from threading import Lock
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

Precision = Literal["fp32", "tf32", "bf16", "auto"]
"""Number type of products and convolutions. ``tf32`` multiplies 32-bit numbers rounded to 11 digits on GPUs that have
instructions for it, and is ``fp32`` elsewhere. Torch's own default is that for convolutions."""


def has_bf16() -> bool:
    """Return whether this machine computes in bfloat16 natively."""
    if torch.cuda.is_available():
        return torch.cuda.is_bf16_supported(including_emulation=False)
    # Torch has no public question for this yet; a torch without this one is taken for a machine without bfloat16.
    return bool(getattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)())


def at_least_32_bits(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return numbers in 32 bits, or in 64 if they have as many: for what 16 bits cannot tell."""
    return x.to(torch.promote_types(x.dtype, torch.float32))


def as_in_products(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return numbers as products with them are computed here: in the 16 bits of autocast, or as they are."""
    kind = _kind_of(x.device)
    return x.to(torch.get_autocast_dtype(kind)) if torch.is_autocast_enabled(kind) else x


def without_autocast(device: torch.device) -> AbstractContextManager[object]:
    """Compute in the numbers' own precision within the ``with`` block, whatever the training has chosen around it."""
    return torch.autocast(_kind_of(device), enabled=False)


def _kind_of(device: torch.device) -> str:
    return "cpu" if device.type == "meta" else device.type  # autocast knows no tensors without values


@contextmanager
def in_full(device: torch.device) -> Iterator[None]:
    """Compute as outside of training within the ``with`` block: without autocast, and products in all 32 bits."""
    with without_autocast(device), products_in("fp32"):
        yield


@contextmanager
def inference() -> Iterator[None]:
    """Compute without gradients, and products of 32-bit numbers in all their bits unless settings say otherwise."""
    with torch.no_grad(), products_in("fp32"):
        yield


@contextmanager
def autocast_to(precision: Precision, device: torch.device) -> Iterator[None]:
    """Compute products and convolutions within the ``with`` block in a precision; outputs may have 16 bits."""
    short = dtype_of(precision) == torch.bfloat16
    with torch.autocast(device.type, torch.bfloat16, enabled=short), products_in(precision):
        yield


def dtype_of(precision: Precision) -> torch.dtype:
    """Return the type of a precision's numbers; ``auto`` is bf16 where the machine has instructions for it."""
    return torch.bfloat16 if precision == "bf16" or (precision == "auto" and has_bf16()) else torch.float32


_lock = Lock()
_asked_for: list[Precision] = []  # by all ``with`` blocks in progress, of any thread
_callers: list[tuple[str, bool]] = []  # what the program around us had chosen, while there are any


@contextmanager
def products_in(precision: Precision) -> Iterator[None]:
    """Multiply 32-bit numbers within the ``with`` block in TF32 where the precision says so, and else in all 32 bits.

    Torch has one setting for the whole process. It is given back at the end of the last block of all threads.
    """
    with _lock:
        if not _asked_for:
            _callers.append((torch.get_float32_matmul_precision(), torch.backends.cudnn.allow_tf32))
        before = _asked_for[-1:]
        _asked_for.append(precision)
        _set_products(precision)
    try:
        yield
    finally:
        with _lock:
            _asked_for.remove(precision)
            if not _asked_for:
                products, torch.backends.cudnn.allow_tf32 = _callers.pop()
                torch.set_float32_matmul_precision(products)
            elif before:
                _set_products(before[0])


def _set_products(precision: Precision) -> None:
    torch.set_float32_matmul_precision("high" if precision == "tf32" else "highest")
    torch.backends.cudnn.allow_tf32 = precision == "tf32"

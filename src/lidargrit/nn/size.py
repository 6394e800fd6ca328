"""Bounds on what is built and computed at once: settings → a network, a batch → what it gives, or an error."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from torch.nn.modules.module import (
    register_module_buffer_registration_hook,
    register_module_module_registration_hook,
    register_module_parameter_registration_hook,
)

from lidargrit.core.errors import ConfigError, first_words

NUMBERS_AT_MOST = 2**30  # 4.3 GB in 32 bits, thirty times the largest network of our presets
_MODULES_AT_MOST = 20_000  # many small ones take minutes to build; the largest networks of our presets have 2,000


@contextmanager
def numbers_at_most(
    count: int = NUMBERS_AT_MOST, what: str = "a network", cure: str = "lower its widths, layers or codes"
) -> Iterator[None]:
    """Refuse to build networks of more than ``count`` numbers within the ``with`` block, before memory is filled.

    Networks that other threads build meanwhile do not count.

    Weights and buffers are counted as modules register them, which they do before they fill them. More than
    20,000 modules are refused, too, however small they are.

    Args:
        count: largest number of weights and buffer elements of all modules that are built in the block.
    """
    found, own = {"numbers": 0, "modules": 0}, threading.get_ident()  # the hooks see the networks of all threads

    def add(unit: str, number: int, at_most: int) -> None:
        if threading.get_ident() == own:
            found[unit] += number
            if found[unit] > at_most:
                raise ConfigError(f"{what} of more than {at_most:,} {unit}", "fewer", cure)

    def add_tensor(module: nn.Module, name: str, tensor: Tensor | None) -> None:
        add("numbers", 0 if tensor is None else tensor.numel(), count)

    def add_module(module: nn.Module, name: str, part: nn.Module | None) -> None:
        add("modules", 1, _MODULES_AT_MOST)

    hooks = [
        register_module_parameter_registration_hook(add_tensor),
        register_module_buffer_registration_hook(add_tensor),
        register_module_module_registration_hook(add_module),
    ]
    try:
        yield
    except (RuntimeError, MemoryError, OverflowError, TypeError) as error:  # a single tensor that no machine can hold
        if isinstance(error, TypeError) and "Overflow" not in str(error):  # torch's of sizes beyond 64 bits
            raise
        got = f"{what} that cannot be built ({first_words(error)})"
        raise ConfigError(got, f"at most {count:,} numbers", cure) from None
    finally:
        for hook in hooks:
            hook.remove()


class TooLargeError(ConfigError):
    """More than a GPU's memory holds was to be computed at once."""


@contextmanager
def within_memory(scans: int, cure: str) -> Iterator[None]:
    """Tell in one line that a GPU has no memory for what is computed within the ``with`` block.

    The number of scans is not lowered in silence: a seed gives the same scan only in batches of one size.

    Args:
        scans: number of scans that are computed at once.
        cure: setting that takes less memory.
    """
    try:
        yield
    except torch.OutOfMemoryError as error:
        torch.cuda.empty_cache()
        reason = str(error).partition(". ")[0]
        raise TooLargeError(f"{scans} scans at once ({reason})", "what the GPU's memory holds", cure) from None

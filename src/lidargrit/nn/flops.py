"""The number of operations of one pass through a network, counted without computing it."""

from collections.abc import Callable
from itertools import chain
from typing import Any

import torch
from torch import nn
from torch._ops import OpOverload
from torch.func import functional_call
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry


class FlopCounter(TorchDispatchMode):
    """Counts the floating-point operations of products and convolutions within its ``with`` block.

    A multiplication with its addition counts as two. Torch's own counter counts the same by the same formulas; it also
    keeps account of modules, which takes most of its time and fails on gradient penalties.

    Attributes:
        total: number of operations so far.
    """

    def __init__(self) -> None:
        super().__init__()
        self.total = 0
        self._unfused = sdpa_kernel(SDPBackend.MATH)  # fused attention hides its products from a dispatcher

    def __enter__(self) -> "FlopCounter":
        self._unfused.__enter__()
        super().__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        self._unfused.__exit__(*error)

    def __torch_dispatch__(
        self, func: OpOverload, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        found = func(*args, **(kwargs or {}))
        formula: Callable[..., int] | None = flop_registry.get(func._overloadpacket)
        if formula is not None:
            self.total += formula(*args, **(kwargs or {}), out_val=found)
        return found


def flops_of(module: nn.Module, *shapes: tuple[int, ...]) -> int:
    """Count the floating-point operations of one forward pass over inputs of the given shapes.

    Only products and convolutions count, a multiplication with its addition as two. The module runs on tensors that
    have a shape and no values, so that nothing is computed.
    """
    tensors = {
        name: torch.empty_like(tensor, device="meta")
        for name, tensor in chain(module.named_parameters(), module.named_buffers())
    }
    with torch.no_grad(), FlopCounter() as counter:
        functional_call(module, tensors, tuple(torch.empty(shape, device="meta") for shape in shapes))
    return counter.total

"""The number of operations of one pass through a network, counted without computing it."""

from __future__ import annotations

from itertools import chain

import torch
from torch import nn
from torch.func import functional_call
from torch.utils.flop_counter import FlopCounterMode


def flops_of(module: nn.Module, *shapes: tuple[int, ...]) -> int:
    """Count the floating-point operations of one forward pass over inputs of the given shapes.

    Only products and convolutions count, a multiplication with its addition as two. The module runs on tensors that
    have a shape and no values, so that nothing is computed.
    """
    tensors = {
        name: torch.empty_like(tensor, device="meta")
        for name, tensor in chain(module.named_parameters(), module.named_buffers())
    }
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        functional_call(module, tensors, tuple(torch.empty(shape, device="meta") for shape in shapes))
    return counter.get_total_flops()

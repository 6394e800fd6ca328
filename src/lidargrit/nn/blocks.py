"""Networks and the blocks they repeat: activations kept → computed twice instead; layer by layer → compiled."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn
from torch.utils.checkpoint import checkpoint

from lidargrit.errors import ConfigError


class Network(nn.Module):
    """Tensors of fixed sizes in, tensors out, and nothing besides: what ``torch.compile`` takes as a whole."""


class Block(nn.Module):
    """What a network repeats. While it is trained, its activations may be dropped and computed again for gradients."""

    recomputed = False

    def __call__(self, *inputs: Any) -> Any:
        """Compute, as every module does."""
        if self.recomputed and self.training and torch.is_grad_enabled():
            return checkpoint(super().__call__, *inputs, use_reentrant=False)
        return super().__call__(*inputs)


def prepare_for_training(objective: nn.Module, recompute: bool, compiled: bool) -> None:
    """Arrange how an objective's networks compute while they are trained; names and weights stay as they are.

    Args:
        objective: whose they are.
        recompute: let every block compute its activations again in place of keeping them. Gradients stay the same,
            dropout included.
        compiled: have every network compiled when it is first called.

    Raises:
        ConfigError: there is nothing in it that could.
    """
    for block in _those(objective, Block, "recompute") if recompute else ():
        block.recomputed = True
    for network in _those(objective, Network, "compile") if compiled else ():
        network.compile()


def _those(objective: nn.Module, kind: type[nn.Module], setting: str) -> list[Any]:
    found = [module for module in objective.modules() if isinstance(module, kind)]
    if not found:
        raise ConfigError(
            f"{setting}=true for {type(objective).__name__}, which cannot", "false", f"leave {setting} out"
        )
    return found

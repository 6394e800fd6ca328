"""Base classes of networks and of their repeated blocks; compilation and recomputation in training."""

from typing import Any, TypeVar

import torch
from torch import nn
from torch.utils.checkpoint import checkpoint

from lidargrit.core.errors import ConfigError

ModuleT = TypeVar("ModuleT", bound=nn.Module)


class Network(nn.Module):
    """A module that only maps tensors of fixed sizes to tensors, so that ``torch.compile`` can take all of it."""


class Block(nn.Module):
    """A part that a network repeats; in training its activations may be dropped and computed again for gradients."""

    recomputed = False

    def __call__(self, *inputs: Any) -> Any:
        """Call ``forward``, which keeps the inputs only if activations are to be recomputed."""
        if self.recomputed and self.training and torch.is_grad_enabled():
            return checkpoint(super().__call__, *inputs, use_reentrant=False)
        return super().__call__(*inputs)


def prepare_for_training(objective: nn.Module, recompute: bool, compiled: bool) -> None:
    """Set how an objective's networks compute in training; the names and values of weights stay the same.

    Args:
        recompute: whether every block drops its activations and computes them again for the gradients, which stay the
            same, dropout included.
        compiled: whether every network is compiled when it is first called.
    """
    for block in _parts(objective, Block, "recompute", recompute):
        block.recomputed = recompute  # a stage before may have trained the same network otherwise
    for network in _parts(objective, Network, "compile", compiled):
        if compiled:
            network.compile()


def zeroed(layer: ModuleT) -> ModuleT:
    """Set the weights of a layer to zero, so that a new block adds nothing, and return it."""
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)
    return layer


def _parts(objective: nn.Module, kind: type[ModuleT], setting: str, wanted: bool) -> list[ModuleT]:
    found = [module for module in objective.modules() if isinstance(module, kind)]
    if wanted and not found:
        raise ConfigError(
            f"{setting}=true for {type(objective).__name__}, which has no {kind.__name__}",
            "false",
            f"leave {setting} out",
        )
    return found

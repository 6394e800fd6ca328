"""Weights of a file → the module of the very same layout; others are refused."""

from pathlib import Path

import torch
from jaxtyping import Shaped
from torch import Tensor, nn

from lidargrit.core.errors import CheckpointError


def load_exactly(module: nn.Module, weights: dict[str, Tensor], source: Path) -> None:
    """Load weights into a module of the very same layout.

    Args:
        module: module that gets the weights; it stays as it is if they are refused.

    Raises:
        CheckpointError: a name, a size or a kind of number differs, or a parameter is not finite; names the first.
            Buffers may be NaN: some stand for what was never fitted.
    """
    wanted = module.state_dict()
    parameters = {name for name, _ in module.named_parameters(remove_duplicate=False)}
    cure = "load them with the configuration that they were trained with"
    for name in sorted(wanted.keys() | weights.keys()):
        if name not in weights or name not in wanted:
            side = "lacks" if name in wanted else "has besides"
            raise CheckpointError(
                f"weights in {source} of another configuration (the file {side} {name!r})", "those of this model", cure
            )
        given, own = weights[name], wanted[name]
        if given.shape != own.shape:
            got = f"weights in {source} of another configuration ({name!r} is {tuple(given.shape)})"
            raise CheckpointError(got, f"{tuple(own.shape)}", cure)
        if _kind(given) != _kind(own):
            got = f"weights in {source}, of which {name!r} is of {_kind(given)}"
            raise CheckpointError(got, _kind(own), "restore the file, or train again")
        if name in parameters and not _is_finite(given.to(own.dtype)):
            got = f"weights in {source}, of which {name!r} holds NaN or infinity"
            raise CheckpointError(got, "finite numbers", "restore the file, or train again")
    module.load_state_dict(weights)


def _kind(tensor: Shaped[Tensor, "..."]) -> str:
    """Return the kind of a tensor's numbers: loading would convert one into another without a word."""
    if tensor.dtype == torch.bool:
        return "truth values"
    if tensor.is_complex():
        return "complex numbers"
    return "real numbers" if tensor.is_floating_point() else "whole numbers"


def _is_finite(tensor: Shaped[Tensor, "..."]) -> bool:
    if not tensor.numel():
        return True
    low, high = tensor.aminmax()  # NaN where any is: no comparison holds; a twentieth of the time of isfinite
    return bool(low > -torch.inf) and bool(high < torch.inf)

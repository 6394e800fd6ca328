"""Weights of a file → the module of the very same layout; others are refused."""

from collections.abc import Mapping
from pathlib import Path

import torch
from jaxtyping import Shaped
from torch import Tensor, nn

from lidargrit.core.errors import CheckpointError

_NAMED = 3  # weights of each kind of difference in a message


def load_exactly(module: nn.Module, weights: dict[str, Tensor], source: Path) -> None:
    """Load weights into a module of the very same layout.

    Args:
        module: module that gets the weights; it stays as it is if they are refused.

    Raises:
        CheckpointError: a name, a size or a kind of number differs, or a parameter is not finite; counts the names and
            the sizes that differ, and names the first of each.
            Buffers may be NaN: some stand for what was never fitted.
    """
    wanted = module.state_dict()
    parameters = {name for name, _ in module.named_parameters(remove_duplicate=False)}
    cure = "load them with the configuration that they were trained with"
    if differences := _differences(wanted, weights):
        got = f"weights in {source} of another configuration ({'; '.join(differences)})"
        raise CheckpointError(got, f"the {len(wanted)} of this model", cure)
    for name, own in sorted(wanted.items()):
        given = weights[name]
        if _kind(given) != _kind(own):
            got = f"weights in {source}, of which {name!r} is of {_kind(given)}"
            raise CheckpointError(got, _kind(own), "restore the file, or train again")
        if name in parameters and not _is_finite(given.to(own.dtype)):
            got = f"weights in {source}, of which {name!r} holds NaN or infinity"
            raise CheckpointError(got, "finite numbers", "restore the file, or train again")
    module.load_state_dict(weights)


def _differences(wanted: Mapping[str, Tensor], given: Mapping[str, Tensor]) -> list[str]:
    """Return how the layout of a file differs from the wanted one, each kind of difference with its first names."""
    both = sorted(wanted.keys() & given.keys())
    found = {
        "the file lacks": [repr(name) for name in sorted(wanted.keys() - given.keys())],
        "the file has besides": [repr(name) for name in sorted(given.keys() - wanted.keys())],
        "of another size": [
            f"{name!r} {_size(given[name])} in place of {_size(wanted[name])}"
            for name in both
            if given[name].shape != wanted[name].shape
        ],
    }
    return [
        f"{kind} {', '.join(names[:_NAMED])}{f' and {len(names) - _NAMED} more' if len(names) > _NAMED else ''}"
        for kind, names in found.items()
        if names
    ]


def _size(tensor: Shaped[Tensor, "..."]) -> str:
    return "x".join(map(str, tensor.shape)) or "a number"


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

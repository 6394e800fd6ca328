"""Weights of a pixel decoder behind a tokenizer → those of one behind the past, which training goes on from."""

from collections.abc import Mapping

import torch
from torch import Tensor

from lidargrit.systems.forecaster.network import COMPONENTS

_CELL = 4  # pixels of a cell, each a channel
_TOLD = 2  # channels of a pixel besides features and rows: the range that is told, and the logit of a return


def behind_past(trained: Mapping[str, Tensor], own: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return what a decoder behind a tokenizer has learned, where shapes agree or new channels can be 0.

    The tokenizer's features have no counterpart, and weights of them begin at 0. Inputs and components that only the
    past brings lie behind the others.

    Args:
        trained: weights of the trained decoder.
        own: weights that begin untrained.
    """
    found = dict[str, Tensor]()
    for name in own.keys() & trained.keys():
        given, like = trained[name], own[name]
        if name.endswith(".guide.weight"):
            rows = own[f"{name.partition('.networks.')[0]}.rows"].shape[0]
            kept = _CELL * (rows + _TOLD)
            weight = torch.zeros_like(like)
            weight[:, -kept:] = given[:, -kept:]
        elif name.endswith(".context.weight"):
            weight = torch.zeros_like(like)
            weight[:, : given.shape[1]] = given
        elif ".out." in name and given.shape != like.shape:
            parts = [torch.cat((part, part.new_zeros(COMPONENTS, *part.shape[1:]))) for part in given.chunk(3)]
            weight = torch.cat(parts)
        else:
            weight = given
        if weight.shape == like.shape and ".features." not in name:
            found[name] = weight
    return found

"""Attention of tokens to their neighbours, on a grid whose columns wrap: (queries, keys, values) → values."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

_ROWS = 3  # of the window, as R2Flow has it
_REACH = 4  # columns of the window on each side of the token
_COLUMNS_AT_ONCE = 8  # more have fewer copies of keys, and more products that come to nothing


def neighbourhood_attention(
    q: Float[Tensor, "B heads h w d"], k: Float[Tensor, "B heads h w d"], v: Float[Tensor, "B heads h w d"]
) -> Float[Tensor, "B heads h w d"]:
    """Mix the values of 3x9 tokens around each token, by the softmax of the products of queries and keys.

    Columns wrap. In the first and the last row the window lies inwards, so that it always has 3 rows, or all where
    there are fewer. On a grid of fewer than 9 columns a token counts once for every time that the window covers it.

    Source:
        Hassani et al., Neighborhood Attention Transformer, CVPR 2023, with the window of Nakashima et al., R2Flow, ICRA
        2025.
    """
    columns = q.shape[3]
    together = next(size for size in range(_COLUMNS_AT_ONCE, 0, -1) if columns % size == 0)
    keys, values = (_windows(each, together) for each in (k, v))  # each (B, heads, h, w / together, d, keys)
    logits = (q.unflatten(3, (-1, together)) @ keys).float()  # (B, heads, h, w / together, together, keys)
    column = torch.arange(together, device=q.device)[:, None]
    offset = torch.arange(together + 2 * _REACH, device=q.device) - column
    seen = ((offset >= 0) & (offset <= 2 * _REACH)).repeat_interleave(min(_ROWS, q.shape[2]), dim=1)
    weights = logits.masked_fill(~seen, -torch.inf).softmax(-1).type_as(values)
    return (weights @ values.transpose(-1, -2)).flatten(3, 4)


def _windows(x: Float[Tensor, "B heads h w d"], together: int) -> Float[Tensor, "B heads h n d keys"]:
    """Return what each group of neighbouring columns may see: columns one after the other, and the rows of each."""
    rows = min(_ROWS, x.shape[2])
    before, after = (rows - 1) // 2, rows // 2
    turns = [x] * -(-_REACH // x.shape[3])
    x = torch.cat((torch.cat(turns, 3)[:, :, :, -_REACH:], x, torch.cat(turns, 3)[:, :, :, :_REACH]), dim=3)
    x = x.unfold(3, together + 2 * _REACH, together).unfold(2, rows, 1)  # (B, heads, h - rows + 1, n, d, columns, rows)
    x = torch.cat((*[x[:, :, :1]] * before, x, *[x[:, :, -1:]] * after), dim=2)
    return x.flatten(-2)

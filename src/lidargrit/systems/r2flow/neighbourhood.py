"""Attention of tokens to their neighbours, on a grid whose columns wrap: (queries, keys, values) → values."""

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
    keys, values = (_windows(each, together) for each in (k, v))  # each (B, heads, h, w / together, keys, d)
    logits = (q.unflatten(3, (-1, together)) @ keys.transpose(-1, -2)).float()  # (B, heads, h, n, together, keys)
    column = torch.arange(together, device=q.device)[:, None]
    offset = torch.arange(together + 2 * _REACH, device=q.device) - column
    seen = ((offset >= 0) & (offset <= 2 * _REACH)).repeat(1, min(_ROWS, q.shape[2]))
    weights = logits.masked_fill(~seen, -torch.inf).softmax(-1).type_as(values)
    return (weights @ values).flatten(3, 4)


def _windows(x: Float[Tensor, "B heads h w d"], together: int) -> Float[Tensor, "B heads h n keys d"]:
    """Return what each group of neighbouring columns may see: rows one after the other, and the columns of each."""
    # By slices and shifts, since the gradient of Tensor.unfold takes five times as long.
    width, height, rows = together + 2 * _REACH, x.shape[2], min(_ROWS, x.shape[2])
    before, after, inner = (rows - 1) // 2, rows // 2, height - rows + 1
    parts = []
    for each in (x[:, :, row : row + inner] for row in range(rows)):
        shifted = torch.cat((*[each[:, :, :1]] * before, each, *[each[:, :, -1:]] * after), dim=2)
        for start in range(0, width, together):
            groups = shifted.roll(_REACH - start, dims=3).unflatten(3, (-1, together))
            parts.append(groups[..., : width - start, :])
    return torch.cat(parts, dim=4)

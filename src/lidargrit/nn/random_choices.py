"""Random choices by uniform numbers: logits → one index of each row; uniform numbers → Gumbel's noise."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor


def sample_index(logits: Float[Tensor, "*B K"], uniform: Float[Tensor, "*B"]) -> Int[Tensor, "*B"]:
    """Return for each row of logits the index where the distribution function first exceeds the uniform number.

    Args:
        logits: unnormalised logarithms of probabilities.
        uniform: random numbers in [0, 1).
    """
    distribution = logits.double().softmax(dim=-1).cumsum(dim=-1)
    threshold = uniform.double()[..., None] * distribution[..., -1:]  # the sum may miss 1 by a rounding error
    return torch.searchsorted(distribution, threshold, right=True)[..., 0].clamp(max=logits.shape[-1] - 1)


def gumbel_of(uniform: Float[Tensor, "*B"]) -> Float[Tensor, "*B"]:
    """Return random numbers of Gumbel's distribution: the quantiles of uniform numbers in [0, 1), bounded."""
    return -(-uniform.clamp(1e-9, 1 - 1e-7).log()).log()

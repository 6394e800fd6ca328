"""Seeds → random numbers: one generator for each seed, on the CPU, so that every device gets the same numbers."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor


def rngs_of(seeds: Sequence[int]) -> list[torch.Generator]:
    """Return one random generator on the CPU for each seed."""
    return [torch.Generator().manual_seed(seed) for seed in seeds]


def normal_latents(seeds: Sequence[int], *size: int) -> Float[Tensor, "B *size"]:
    """Sample standard normal numbers of this size for each seed, on the CPU."""
    return torch.stack([torch.randn(size, generator=rng) for rng in rngs_of(seeds)])

"""Seeds → random numbers, on the CPU, so that every device gets the same; uniform numbers → random choices."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor


def rngs_of(seeds: Sequence[int]) -> list[torch.Generator]:
    """Return one random generator on the CPU for each seed."""
    return [torch.Generator().manual_seed(seed) for seed in seeds]


def of_host(rng: torch.Generator) -> torch.Generator:
    """Return a source of random numbers whose values the host knows without waiting for a device.

    Ask for it once a step, and hand it on: of a device's source each call begins with the same numbers.
    """
    return rng if rng.device.type == "cpu" else torch.Generator().manual_seed(rng.initial_seed())


def normal_latents(seeds: Sequence[int], *size: int) -> Float[Tensor, "B *size"]:
    """Sample standard normal numbers of this size for each seed, on the CPU."""
    return torch.stack([torch.randn(size, generator=rng) for rng in rngs_of(seeds)])


class SeededNoise:
    """Standard normal images, each sampled on the CPU by its own seed: the same on every device and in every batch."""

    def __init__(self, seeds: Sequence[int], shape: tuple[int, int, int], device: torch.device) -> None:
        self.rngs = rngs_of(seeds)
        self._shape, self._device = shape, device

    def __call__(self) -> Float[Tensor, "B C H W"]:
        """Sample the next image of each seed."""
        return torch.stack([torch.randn(self._shape, generator=rng) for rng in self.rngs]).to(self._device)

    def uniform(self) -> Float[Tensor, "B C H W"]:
        """Sample the next image of each seed, with values that are uniform in [0, 1)."""
        return torch.stack([torch.rand(self._shape, generator=rng) for rng in self.rngs]).to(self._device)


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

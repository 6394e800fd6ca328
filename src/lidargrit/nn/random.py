"""Seeds → random numbers that are the same on every device; uniform numbers → random choices."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int, Int64
from torch import Tensor

Words = Int64[Tensor, "..."] | int
_WORD = 0xFFFFFFFF
_FACTORS, _WEYL = (0xD2511F53, 0xCD9E8D57), (0x9E3779B9, 0xBB67AE85)


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
    """Images of random numbers for each seed, made on a device: they do not depend on it or on the rest of a batch.

    Uniform numbers are the same on every device, normal ones up to the last digits of its logarithm, sine and cosine.

    Args:
        seeds: whole numbers from 0 to 2^32 - 1.
        shape: channels, rows and columns of an image.
    """

    def __init__(self, seeds: Sequence[int], shape: tuple[int, int, int], device: torch.device) -> None:
        self._keys = torch.tensor([[int(seed)] for seed in seeds]).to(device)
        self._shape, self._device, self._images = shape, device, 0

    def __call__(self) -> Float[Tensor, "B C H W"]:
        """Sample the next image of each seed, standard normal, by Box and Muller's transform."""
        first, second = self._next().chunk(2)
        radius, angle = (-2 * (1 - first).log()).sqrt(), 2 * math.pi * second
        return self._as_images(torch.cat((radius * angle.cos(), radius * angle.sin())))

    def uniform(self) -> Float[Tensor, "B C H W"]:
        """Sample the next image of each seed, with values of 24 bits that are uniform in [0, 1)."""
        return self._as_images(self._next())

    def _next(self) -> Float[Tensor, "4 B n"]:
        """Return at least as many uniform numbers for each seed as an image has, in four parts."""
        blocks = -(-math.prod(self._shape) // 4)
        words = philox((torch.arange(blocks, device=self._device), self._images, 0, 0), (self._keys, 0))
        self._images += 1
        return (words >> 8).float() * 2.0**-24

    def _as_images(self, parts: Float[Tensor, "4 B n"]) -> Float[Tensor, "B C H W"]:
        return parts.transpose(0, 1).flatten(1)[:, : math.prod(self._shape)].unflatten(1, self._shape)


def philox(counter: Sequence[Words], key: Sequence[Words]) -> Int64[Tensor, "4 ..."]:
    """Return four random words of 32 bits for each counter and key: Philox 4x32-10.

    Args:
        counter: four words of 32 bits, numbers or tensors whose shapes broadcast.
        key: two words of 32 bits.

    Source:
        Salmon et al., Parallel Random Numbers: As Easy as 1, 2, 3, SC 2011; its constants.
    """
    for round_ in range(10):
        words = [word + round_ * step & _WORD for word, step in zip(key, _WEYL, strict=True)]
        # Products of 64 bits: torch's wrap into the sign, and the mask drops what the shift copies of it.
        one, other = (word * factor for word, factor in zip(counter[::2], _FACTORS, strict=True))
        counter = (
            (other >> 32 & _WORD) ^ counter[1] ^ words[0],
            other & _WORD,
            (one >> 32 & _WORD) ^ counter[3] ^ words[1],
            one & _WORD,
        )
    return torch.stack(torch.broadcast_tensors(*(torch.as_tensor(word) for word in counter)))


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

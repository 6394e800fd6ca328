"""Diffusion in a thousand steps over latents, and DDIM through some of them: (network, noise) → latents.

Noisy latents at step t are √ᾱ x₀ + √(1 - ᾱ) ε, where ᾱ is the product of 1 - β over the steps so far.

Source:
    Rombach et al., Latent Diffusion, CVPR 2022; numbers from hancyran/LiDAR-Diffusion@8416ddb (MIT).
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

TIME_STEPS = 1000  # of the training
_BETA_FIRST, _BETA_LAST = 0.0015, 0.0195  # variances of the noise that the first and the last of them add
STEPS_AT_MOST = TIME_STEPS // 2  # of the sampling: with more, the program's rule would leave out the noisiest

LatentDenoiser = Callable[[Tensor, Tensor], Tensor]
"""(noisy latents (B, D, h, w), their time step (B,)) → the noise in them."""


def signal_shares() -> Float[Tensor, "1000"]:
    """Return ᾱ of every step, in 64 bits; the square root of β grows linearly."""
    betas = torch.linspace(math.sqrt(_BETA_FIRST), math.sqrt(_BETA_LAST), TIME_STEPS, dtype=torch.float64).square()
    return (1 - betas).cumprod(0)


def noised(
    clean: Float[Tensor, "B D h w"], share: Float[Tensor, "B"], noise: Float[Tensor, "B D h w"]
) -> Float[Tensor, "B D h w"]:
    """Mix latents with noise.

    Args:
        share: ᾱ of each, in 64 bits.
    """
    signal, spread = share.sqrt().to(clean.dtype), (1 - share).sqrt().to(clean.dtype)
    return signal[:, None, None, None] * clean + spread[:, None, None, None] * noise


def ddim_steps(steps: int) -> Int[Tensor, "t"]:
    """Return the time steps at which the network is asked, from the cleanest to the noisiest.

    They begin at 1, and for divisors of 1,000 they are the program's: 1, 21, ... 981 for 50 steps.
    """
    return torch.arange(steps) * TIME_STEPS // steps + 1


def ddim(
    denoiser: LatentDenoiser, noise: Callable[[], Float[Tensor, "B D h w"]], steps: int, eta: float
) -> Float[Tensor, "B D h w"]:
    """Sample latents.

    As in the program, the last step leads to the noise of the first of the thousand and not to none: latents keep
    noise of a standard deviation of 0.039, which the codebook absorbs.

    Args:
        eta: share of a step's noise that is fresh; 0 for the noise of the beginning only.

    Source:
        Song et al., DDIM, 2021, eq. 12 and 16.
    """
    latents, shares, chosen = noise(), signal_shares(), ddim_steps(steps)
    nows = shares[chosen].tolist()
    thens = [float(shares[0]), *nows[:-1]]
    for step, now, then in zip(reversed(chosen.tolist()), reversed(nows), reversed(thens), strict=True):
        predicted = denoiser(latents, torch.full((len(latents),), float(step), device=latents.device))
        clean = (latents - math.sqrt(1 - now) * predicted) / math.sqrt(now)
        fresh = eta * math.sqrt((1 - then) / (1 - now) * (1 - now / then))
        latents = math.sqrt(then) * clean + math.sqrt(1 - then - fresh**2) * predicted
        if fresh:
            latents = latents + fresh * noise()
    return latents

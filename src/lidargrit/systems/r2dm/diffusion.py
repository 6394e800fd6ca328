"""Gaussian diffusion in continuous time, by its log signal-to-noise ratio: (network, noise) → images.

An image x at log SNR λ is α x₀ + σ ε with α² = sigmoid(λ), σ² = sigmoid(-λ). Time runs from 0, clean, to 1, noise.

Source:
    Kingma et al., Variational Diffusion Models, 2021; the cosine schedule of Nichol and Dhariwal, 2021, cut at |λ| = 15
    as in Nakashima and Kurazume, R2DM, ICRA 2024, and kazuto1011/r2dm@1c5963d (MIT).
"""

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

Sampler = Literal["ddpm", "ddim"]
Denoiser = Callable[[Tensor, Tensor], Tensor]
"""(noisy images (B, C, H, W), their log SNR (B,)) → the noise in them."""

_LIMIT = 15.0  # of the log SNR, at both ends


def log_snr_at(time: Float[Tensor, "*t"]) -> Float[Tensor, "*t"]:
    """Return the log SNR of times in [0, 1], from 15 down to -15."""
    first, last = math.atan(math.exp(-_LIMIT / 2)), math.atan(math.exp(_LIMIT / 2))
    return -2 * torch.log(torch.tan(first + time * (last - first)))


def alpha_sigma(log_snr: Float[Tensor, "*t"]) -> tuple[Float[Tensor, "*t"], Float[Tensor, "*t"]]:
    """Return the shares of the image and of the noise."""
    return log_snr.sigmoid().sqrt(), (-log_snr).sigmoid().sqrt()


def noised(
    clean: Float[Tensor, "B C H W"], log_snr: Float[Tensor, "*B"], noise: Float[Tensor, "B C H W"]
) -> Float[Tensor, "B C H W"]:
    """Mix images with noise, each at its own log SNR or all at one."""
    alpha, sigma = alpha_sigma(log_snr[..., None, None, None].float().to(clean.device))
    return alpha * clean + sigma * noise


def min_snr_weight(log_snr: Float[Tensor, "*B"], most: float = 5.0) -> Float[Tensor, "*B"]:
    """Return min(SNR, most) / SNR, the weight of an error of the noise; it is min(SNR, most) for one of the image.

    Source:
        Hang et al., Efficient Diffusion Training via Min-SNR Weighting, 2023.
    """
    return (most * torch.exp(-log_snr)).clamp(max=1)


def step_back(
    noisy: Float[Tensor, "B C H W"],
    predicted: Float[Tensor, "B C H W"],
    now: Float[Tensor, ""],
    then: Float[Tensor, ""],
    fresh: Float[Tensor, "B C H W"] | None,
) -> Float[Tensor, "B C H W"]:
    """Go to a cleaner image: the predicted clean image is clipped to [-1, 1], and combined with the noisy one.

    Args:
        now: log SNR of the noisy images.
        then: log SNR to go to, higher than ``now``.
        fresh: fresh noise, to sample from q(x then | x now, x₀) (DDPM); None keeps the predicted noise (DDIM).

    Source:
        Ho et al., DDPM, 2020, eq. 6 and 7; Song et al., DDIM, 2021, eq. 12 with σ = 0; in log SNR as Kingma et al.,
        2021, appendix A. As in the reference, DDIM's noise is that which goes with the cut image.
    """
    (alpha_now, sigma_now), (alpha_then, sigma_then) = _scalars(now), _scalars(then)
    clean = ((noisy - sigma_now * predicted) / alpha_now).clamp(-1, 1)
    if fresh is None:
        return alpha_then * clean + sigma_then / sigma_now * (noisy - alpha_now * clean)
    share = -math.expm1(float(now) - float(then))  # 1 - SNR now / SNR then
    mean = alpha_then * ((1 - share) / alpha_now * noisy + share * clean)
    return mean + sigma_then * math.sqrt(share) * fresh


def step_forward(
    image: Float[Tensor, "B C H W"], now: Float[Tensor, ""], then: Float[Tensor, ""], fresh: Float[Tensor, "B C H W"]
) -> Float[Tensor, "B C H W"]:
    """Go to a noisier image, sampled from q(x then | x now).

    Source:
        Kingma et al., 2021, appendix A.
    """
    (alpha_now, sigma_now), (alpha_then, sigma_then) = _scalars(now), _scalars(then)
    kept = alpha_then / alpha_now
    return kept * image + math.sqrt(sigma_then**2 - kept**2 * sigma_now**2) * fresh


def sample(
    denoiser: Denoiser, noise: Callable[[], Float[Tensor, "B C H W"]], steps: int, sampler: Sampler
) -> Float[Tensor, "B C H W"]:
    """Sample images in equal steps of time.

    Args:
        sampler: ``ddpm`` adds fresh noise after each step, ``ddim`` only at the beginning.
    """
    image = noise()
    for now, then in pairwise(_times(steps)):
        predicted = _evaluated(denoiser, image, now)
        image = step_back(image, predicted, now, then, noise() if sampler == "ddpm" else None)
    return image


def repaint(
    denoiser: Denoiser,
    noise: Callable[[], Float[Tensor, "B C H W"]],
    clean: Float[Tensor, "B C H W"],
    observed: Bool[Tensor, "B 1 H W"],
    steps: int,
    resamples: int,
) -> Float[Tensor, "B C H W"]:
    """Sample images that agree with their observed pixels.

    Args:
        clean: observed values; other pixels may hold anything.
        observed: mask, True where a pixel was observed.
        resamples: number of times that each step is taken. Between two times, fresh noise takes the image back to the
            noise level before, so that observed and generated pixels fit each other. The last step is taken once, as in
            the reference.

    Source:
        Lugmayr et al., RePaint, CVPR 2022, algorithm 1 with jumps of one step.
    """
    image = noise()
    times = _times(steps)
    for now, then in pairwise(times):
        last_step = bool(then == times[-1])
        for turn in range(1 if last_step else resamples):
            if turn:
                image = step_forward(image, then, now, noise())
            noised_observed = noised(clean, then, noise())
            image = step_back(image, _evaluated(denoiser, image, now), now, then, noise())
            image = torch.where(observed, noised_observed, image)
    return image


def _times(steps: int) -> Float[Tensor, "t"]:
    return log_snr_at(torch.linspace(1, 0, steps + 1, dtype=torch.float64))


def _evaluated(denoiser: Denoiser, image: Tensor, log_snr: Tensor) -> Tensor:
    return denoiser(image, log_snr.float().to(image.device).expand(len(image)))


def _scalars(log_snr: Tensor) -> tuple[float, float]:
    alpha, sigma = alpha_sigma(log_snr.double())
    return float(alpha), float(sigma)

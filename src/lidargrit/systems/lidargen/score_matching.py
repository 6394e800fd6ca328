"""Denoising score matching at several noise levels, and annealed Langevin dynamics: (score network, noise) → images.

An image at noise level sigma is x + sigma ε; clean values lie in [0, 1].

Source:
    Song and Ermon, Improved Techniques for Training Score-Based Generative Models, NeurIPS 2020; observed pixels as in
    Zyrianov et al., LiDARGen, ECCV 2022, section 3.4; numbers from vzyrianov/lidargen@4c3226c (MIT).
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

ScoreNetwork = Callable[[Tensor, Tensor], Tensor]
"""(noisy images (B, C, H, W), their sigma (B,)) → scores (B, C, H, W)."""


def sigma_table(largest: float, smallest: float, levels: int) -> Float[Tensor, "levels"]:
    """Return noise levels that fall from the largest to the smallest by one factor."""
    return torch.linspace(math.log(largest), math.log(smallest), levels, dtype=torch.float64).exp().float()


def score_matching_errors(
    network: ScoreNetwork, clean: Float[Tensor, "B C H W"], sigma: Float[Tensor, "B"], noise: Float[Tensor, "B C H W"]
) -> Float[Tensor, "B"]:
    """Return half the squared error of each image's score, summed over its values and weighed by sigma squared."""
    spread = sigma[:, None, None, None]
    score = network(clean + spread * noise, sigma).float()
    return 0.5 * (score * spread + noise).square().sum((1, 2, 3))


def langevin(
    network: ScoreNetwork,
    start: Float[Tensor, "B C H W"],
    noise: Callable[[], Float[Tensor, "B C H W"]],
    sigmas: Float[Tensor, "levels"],
    steps_each: int,
    step_lr: float,
    pull: Callable[[Float[Tensor, "B C H W"]], Float[Tensor, "B C H W"]] | None = None,
) -> Float[Tensor, "B C H W"]:
    """Sample images by annealed Langevin dynamics, and remove the noise that is left at the last level.

    Args:
        noise: source of fresh standard normal values at each call.
        sigmas: noise levels, the largest first.
        steps_each: number of steps at each level.
        step_lr: size of a step at the last level; at other levels it grows with sigma squared.
        pull: term added to the images in each step, which moves them towards observed pixels; None to sample freely.
    """
    image, residual = start, None
    for sigma in sigmas.to(start.device):
        step = step_lr * float(sigma / sigmas[-1]) ** 2
        for _ in range(steps_each):
            residual = None if pull is None else pull(image)
            image = image + step * network(image, sigma.expand(len(image))) + math.sqrt(2 * step) * noise()
            image = image if residual is None else image + residual
    last = sigmas[-1].to(start.device)
    image = image + last**2 * network(image, last.expand(len(image)))
    if pull is None or residual is None:
        return image
    image = image + residual  # of the last step, as in the reference
    return image + pull(image)


def noise_left(sigmas: Float[Tensor, "levels"], steps_each: int, step_lr: float) -> float:
    """Return the standard deviation of the noise that :func:`langevin` ends with, over that of the last level.

    It is computed for a network that knows all noise of an image and answers, as NCSNv2 does, with its direction alone.
    Where levels fall faster than steps remove noise, the noise of the images stays behind and is never removed.
    """
    share, left = step_lr / float(sigmas[-1]) ** 2, 0.0
    for sigma in sigmas.tolist():
        for _ in range(steps_each):
            left = math.hypot(left - share * sigma, math.sqrt(2 * share) * sigma)
    return left / float(sigmas[-1])


def step_that_leaves_least(sigmas: Float[Tensor, "levels"], steps_each: int) -> float:
    """Return the size of a step, in tenths of the last level's variance, by which the least noise is left."""
    sizes = [share / 10 * float(sigmas[-1]) ** 2 for share in range(1, 21)]
    return min(sizes, key=lambda step_lr: noise_left(sigmas, steps_each, step_lr))


def pull_towards(
    observed: Bool[Tensor, "B 1 H W"], reference: Float[Tensor, "B C H W"], strength: float
) -> Callable[[Float[Tensor, "B C H W"]], Float[Tensor, "B C H W"]]:
    """Return the term that moves images towards observed values; with strength 1 it is their whole difference.

    Args:
        observed: True for observed values.
        reference: observed values; those elsewhere have no influence.
        strength: share of the difference that one step makes up.
    """
    return lambda image: torch.where(observed, strength * (reference - image), 0)

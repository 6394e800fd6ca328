"""Rectified flow: straight ways from noise to images, learned as a velocity: (network, noise) → images.

Time runs from 0, noise, to 1, clean; at time t an image is (1 - t) noise + t clean, and its velocity clean - noise.

Source:
    Liu et al., Flow Straight and Fast: Learning to Generate and Transfer Data with Rectified Flow, ICLR 2023.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy.integrate import solve_ivp
from torch import Tensor

from lidargrit.errors import ConfigError

Velocity = Callable[[Tensor, Tensor], Tensor]
"""(images (B, C, H, W), their times (B,)) → their velocities."""


class Solved(NamedTuple):
    """Where a flow ends.

    Args:
        images: clean images.
        evaluations: number of evaluations of the velocity.
    """

    images: Float[Tensor, "B C H W"]
    evaluations: int


def interpolated(
    noise: Float[Tensor, "B C H W"], clean: Float[Tensor, "B C H W"], time: Float[Tensor, "B"]
) -> Float[Tensor, "B C H W"]:
    """Return the images at these times on the straight way from noise to clean images."""
    return torch.lerp(noise, clean, time[:, None, None, None])


def euler(velocity: Velocity, noise: Float[Tensor, "B C H W"], steps: int) -> Solved:
    """Follow a flow in equal steps of time, with one evaluation each.

    Args:
        velocity: trained network.
        noise: images at time 0.
        steps: number of steps.
    """
    image = noise
    for now, then in pairwise(np.linspace(0, 1, steps + 1)):
        image = image + (then - now) * velocity(image, _times(now, image))
    return Solved(image, steps)


def dopri5(velocity: Velocity, noise: Float[Tensor, "B C H W"], tolerance: float) -> Solved:
    """Follow a flow in steps that become shorter where it bends, by the method of Dormand and Prince.

    All images of a batch take the same steps, so a scan that is to depend on its seed alone is a batch of its own.

    Args:
        velocity: trained network.
        noise: images at time 0.
        tolerance: largest error of a step, both in the units of the images and relative to their values.

    Raises:
        ConfigError: the solver finds no step that is short enough.

    Source:
        Dormand and Prince, A family of embedded Runge-Kutta formulae, 1980; scipy's solver, whose norm of an error is
        the root of its mean square, as in torchdiffeq 0.2.5, which R2Flow's program uses.
    """

    def slope(now: float, state: np.ndarray) -> np.ndarray:
        image = torch.from_numpy(state).to(noise).view_as(noise)
        return velocity(image, _times(now, image)).double().flatten().cpu().numpy()

    start = noise.double().flatten().cpu().numpy()
    solved = solve_ivp(slope, (0.0, 1.0), start, method="RK45", t_eval=(1.0,), rtol=tolerance, atol=tolerance)
    if not solved.success:
        raise ConfigError(
            f"a flow that cannot be followed with tolerance={tolerance:g} ({solved.message})",
            "a larger tolerance, or a trained network",
            "raise the tolerance, or use solver=euler",
        )
    return Solved(torch.from_numpy(solved.y[:, -1]).to(noise).view_as(noise), solved.nfev)


def _times(now: float, images: Tensor) -> Tensor:
    return torch.full((len(images),), now, dtype=images.dtype, device=images.device)

"""Rectified flow: straight ways from noise to images, learned as a velocity: (network, noise) → images.

Time runs from 0, noise, to 1, clean; at time t an image is (1 - t) noise + t clean, and its velocity clean - noise.

Source:
    Liu et al., Flow Straight and Fast: Learning to Generate and Transfer Data with Rectified Flow, ICLR 2023.
"""

import math
from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.integrate import solve_ivp
from torch import Tensor

from lidargrit.core.errors import ConfigError

_U_SHAPE = 4.0  # how much likelier the ends are than the middle

Velocity = Callable[[Tensor, Tensor], Tensor]
"""(images (B, C, H, W), their times (B,)) → their velocities."""


class Solved(NamedTuple):
    """Where a flow ends."""

    images: Float[Tensor, "B C H W"]
    evaluations: int


def interpolated(
    noise: Float[Tensor, "B C H W"], clean: Float[Tensor, "B C H W"], time: Float[Tensor, "B"]
) -> Float[Tensor, "B C H W"]:
    """Return the images at these times on the straight way from noise to clean images."""
    return torch.lerp(noise, clean, time[:, None, None, None])


def u_shaped(uniform: Float[Tensor, "B"], order: Int[Tensor, "2*B"]) -> Float[Tensor, "B"]:
    """Return times that lie near 0 and near 1 more often than between them, with a density like exp(4t) + exp(4 - 4t).

    Args:
        order: random order of the times that these give and of their mirror images, of which the first B are taken.

    Source:
        Lee et al., Improving the Training of Rectified Flows, NeurIPS 2024, section 4.1; as in
        kazuto1011/r2flow@3f5afeb (MIT).
    """
    late = (uniform * math.expm1(_U_SHAPE) + 1).log() / _U_SHAPE
    return torch.cat((late, 1 - late))[order[: len(uniform)]]


def pseudo_huber(error: Float[Tensor, "B C H W"], scale: float) -> Float[Tensor, ""]:
    """Return the mean over all values of an error that is squared where it is small, and absolute where it is large.

    Args:
        scale: size of an error between small and large.

    Source:
        Lee et al., Improving the Training of Rectified Flows, NeurIPS 2024, section 4.2, whose norm is that of a whole
        image; of single values in kazuto1011/r2flow@3f5afeb (MIT), as here.
    """
    return ((error.square() + scale**2).sqrt() - scale).mean()


def euler(velocity: Velocity, noise: Float[Tensor, "B C H W"], steps: int) -> Solved:
    """Follow a flow in equal steps of time, with one evaluation each."""
    image = noise
    for now, then in pairwise(np.linspace(0, 1, steps + 1)):
        image = image + (then - now) * velocity(image, _times(now, image))
    return Solved(image, steps)


def dopri5(velocity: Velocity, noise: Float[Tensor, "B C H W"], tolerance: float) -> Solved:
    """Follow a flow in steps that become shorter where it bends, by the method of Dormand and Prince.

    All images of a batch take the same steps, so a scan that is to depend on its seed alone is a batch of its own.

    Args:
        tolerance: largest error of a step, both in the units of the images and relative to their values.

    Raises:
        ConfigError: the solver finds no step that is short enough, or the network gives a velocity that is no number.

    Source:
        Dormand and Prince, A family of embedded Runge-Kutta formulae, 1980; scipy's solver, whose norm of an error is
        the root of its mean square, as in torchdiffeq 0.2.5, which R2Flow's program uses.
    """

    def slope(now: float, state: np.ndarray) -> np.ndarray:
        image = torch.from_numpy(state).to(noise).view_as(noise)
        found = velocity(image, _times(now, image)).double().flatten().cpu().numpy()
        if not np.isfinite(found).all():  # the solver would try shorter steps for ever
            raise ConfigError(
                f"a flow that is not finite at time {now:.3g}", "a network whose training went well", "train it again"
            )
        return found

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

"""Inversion of a generating network: an error as a function of latents → the latents of the least error."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

_NOISE, _NOISE_ENDS = 0.05, 0.75  # deviation of what is added to latents at first; share of steps after which none is
_RISE, _FALL = 0.05, 0.25  # shares of steps in which the rate rises from 0, and falls to 0


def search_latents(
    error_of: Callable[[Tensor], Tensor], noise: Float[Tensor, "B steps_and_start D"], rate: float
) -> Float[Tensor, "B D"]:
    """Search the latent of the least error for each row of a batch, independently.

    Latents stay on the sphere on which almost all random ones lie. Noise is added at first, to leave local minima.

    Args:
        error_of: function from latents (B, D) to one error for each, which depends on that latent alone.
        noise: standard normal numbers: the start of the search, then one disturbance for each step.
        rate: highest learning rate of Adam.

    Source:
        Karras et al., StyleGAN2, 2020, appendix D, with the numbers and the sphere of kazuto1011/dusty-gan@0374a5e,
        evaluate_reconstruction.py.
    """
    steps = noise.shape[1] - 1
    latents = _on_sphere(noise[:, 0]).requires_grad_()
    optimiser = torch.optim.Adam([latents], lr=rate)
    for step in range(steps):
        done = step / steps
        optimiser.param_groups[0]["lr"] = rate * rate_share(done)
        with torch.enable_grad():
            shaken = latents + _NOISE * max(0.0, 1 - done / _NOISE_ENDS) ** 2 * noise[:, step + 1]
            (latents.grad,) = torch.autograd.grad(error_of(shaken).sum(), latents)
        optimiser.step()
        latents.data = _on_sphere(latents.data)
    return latents.detach()


def rate_share(done: float) -> float:
    """Return the share of the highest rate after a share of the steps: up at once, then level, then down a cosine."""
    fall = 0.5 - 0.5 * math.cos(math.pi * min(1.0, (1 - done) / _FALL))
    return fall * min(1.0, done / _RISE)


def _on_sphere(latents: Tensor) -> Tensor:
    return latents / latents.square().mean(dim=1, keepdim=True).add(1e-9).sqrt()  # program's guard against 0

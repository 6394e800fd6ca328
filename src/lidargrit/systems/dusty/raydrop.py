"""Differentiable sampling of returns: logits of a return → 0 or 1 for each ray."""

import torch
from jaxtyping import Float
from torch import Tensor


def logistic_noise(size: tuple[int, ...], rng: torch.Generator) -> Float[Tensor, "..."]:
    """Sample logistic noise: logit + noise is above 0 with the logit's probability."""
    uniform = torch.rand(size, generator=rng, device=rng.device).clamp(min=torch.finfo(torch.float32).tiny)
    return uniform.log() - (-uniform).log1p()


def straight_through(logits: Tensor, noise: Tensor) -> Float[Tensor, "..."]:
    """Return 0 or 1 by the sign of logits + noise, with the gradient of a sigmoid.

    Args:
        noise: noise of the same shape, or of one that broadcasts; see :func:`logistic_noise`.

    Source:
        Maddison et al., The Concrete Distribution, 2017; Jang et al., Gumbel-Softmax, 2017, section 2.2.
    """
    soft = torch.sigmoid(logits.float() + noise)
    return ((soft > 0.5).float() - soft).detach() + soft

"""Principal axes of a codebook: latents ⇄ fewer numbers of unit variance."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

_LEAST_SHARE = 1e-3  # of the largest variance: axes along which codes do not differ are not blown up
_LEAST_VARIANCE = 1e-12  # where one code is all that is used


class LatentAxes(nn.Module):
    """The axes along which the codes of a codebook differ most, each in its own standard deviation.

    Codes may differ along a few of their axes only; noise of one size in all channels then hides little of what they
    say, and most of a network's loss is spent on channels that say nothing.

    Args:
        code_dim: number of channels of a latent.
        axes: number of axes.
    """

    mean: Tensor
    axes: Tensor
    scale: Tensor

    def __init__(self, code_dim: int, axes: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(code_dim))
        self.register_buffer("axes", torch.eye(axes, code_dim))
        self.register_buffer("scale", torch.ones(axes))

    @torch.no_grad()
    def fit(self, codes: Float[Tensor, "K D"], share: Float[Tensor, "K"]) -> None:
        """Fit the axes to codes, each as often as its share says."""
        mean = (share[:, None] * codes).sum(0)
        apart = codes - mean
        variance, axes = torch.linalg.eigh(apart.T @ (share[:, None] * apart))  # the smallest first
        variance, axes = variance.flip(0)[: len(self.axes)], axes.flip(1)[:, : len(self.axes)]
        self.mean.copy_(mean)
        self.axes.copy_(axes.T)
        least = (_LEAST_SHARE * variance[0]).clamp(min=_LEAST_VARIANCE)
        self.scale.copy_(torch.maximum(variance, least).sqrt())

    def forward(self, latents: Float[Tensor, "B D h w"]) -> Float[Tensor, "B axes h w"]:
        """Return latents along the axes."""
        along = torch.einsum("bdhw,ad->bahw", latents - self.mean[:, None, None], self.axes)
        return along / self.scale[:, None, None]

    def latents(self, along: Float[Tensor, "B axes h w"]) -> Float[Tensor, "B D h w"]:
        """Return the latents that lie in the axes."""
        return torch.einsum("bahw,ad->bdhw", along * self.scale[:, None, None], self.axes) + self.mean[:, None, None]

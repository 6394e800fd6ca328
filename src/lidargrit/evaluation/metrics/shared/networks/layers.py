"""Layers of networks that others have trained and that learn no more: features → features."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn


class FrozenNorm(nn.Module):
    """Batch normalisation by the statistics of training, whatever mode the network is in."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        for name in ("weight", "bias", "running_mean", "running_var"):
            self.register_buffer(name, torch.empty(channels))

    def forward(self, x: Float[Tensor, "B C *rest"]) -> Float[Tensor, "B C *rest"]:
        """Return the normalised features; 1e-5 is added to the variance, as everywhere in PyTorch."""
        return F.batch_norm(
            x,
            self.get_buffer("running_mean"),
            self.get_buffer("running_var"),
            self.get_buffer("weight"),
            self.get_buffer("bias"),
        )

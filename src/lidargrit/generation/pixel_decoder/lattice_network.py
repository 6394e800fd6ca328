"""The network of one lattice of a pixel decoder: what is known of its pixels → outputs for those of a phase."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from lidargrit.nn.blocks import Network
from lidargrit.nn.convolution import Convolution, Residual
from lidargrit.nn.precision import at_least_32_bits


class LatticeNetwork(Network):
    """The network of all phases of one lattice, over cells of 2x2 pixels of the lattice.

    The part of the first layer that sees the guide is computed once for all phases.
    """

    def __init__(self, guide: int, context: int, width: int, blocks: int, phases: int, outputs: int) -> None:
        super().__init__()
        self.guide, self.context = Convolution(guide, width, "wrap"), Convolution(context, width, "wrap")
        self.phase_bias = nn.Parameter(torch.zeros(phases, width))
        self.blocks = nn.Sequential(*(Residual(width) for _ in range(blocks)))
        self.out = nn.ModuleList(nn.Conv2d(width, outputs, 1) for _ in range(phases))
        for layer in self.out:
            nn.init.zeros_(layer.get_parameter("weight"))
            nn.init.zeros_(layer.get_parameter("bias"))

    def forward(
        self, guided: Float[Tensor, "B C h w"], contexts: Float[Tensor, "P B D h w"], first: int
    ) -> Float[Tensor, "P B O h w"]:
        """Return the outputs of as many phases as there are contexts, from the phase ``first`` on."""
        size = contexts.shape[:2]
        x = self.context(contexts.flatten(0, 1)).unflatten(0, size)
        x = x + guided + self.phase_bias[first : first + size[0], None, :, None, None]
        x = F.silu(self.blocks(x.flatten(0, 1))).unflatten(0, size)
        outputs = [layer(part) for layer, part in zip(self.out[first:], x, strict=False)]
        return at_least_32_bits(torch.stack(outputs))

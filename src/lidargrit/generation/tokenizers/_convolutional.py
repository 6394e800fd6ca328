"""Base of the VQ-VAEs: checks of sizes, levels of residual blocks, encoder, decoder and codebook."""

from abc import abstractmethod
from collections.abc import Iterable
from typing import Annotated

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from lidargrit.core.errors import ConfigError
from lidargrit.core.typed_values import Bounds
from lidargrit.generation.tokenizers import CodebookTokenizer, Config
from lidargrit.nn.blocks import Network
from lidargrit.nn.codebook import CodebookLoss, VectorQuantiser
from lidargrit.nn.convolution import Convolution
from lidargrit.scans.types import RangeImage

ResidualBlocks = Annotated[int, Bounds(1, 100)]
CodeDim = Annotated[int, Bounds(1, 16_384)]
NumCodes = Annotated[int, Bounds(1, 65_536)]


class Level(nn.Module):
    """One resolution of an encoder or a decoder: residual blocks, then perhaps a change of resolution.

    Args:
        blocks: residual blocks, in their order.
    """

    def __init__(self, blocks: Iterable[nn.Module]) -> None:
        super().__init__()
        self.block = nn.ModuleList(blocks)
        self.downsample: nn.Module | None = None
        self.upsample: nn.Module | None = None

    def forward(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B D h w"]:
        """Return the feature maps of the next level."""
        for block in self.block:
            x = block(x)
        if self.downsample is not None:
            x = self.downsample(x)
        return x if self.upsample is None else self.upsample(x)


class ConvolutionalEncoder(Network):
    """The network from encoded images (B, channels, H, W) to latents (B, code_dim, h, w)."""

    conv_in: Convolution
    down: nn.ModuleList
    mid: nn.Module
    norm_out: nn.Module
    conv_out: Convolution

    def forward(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B D h w"]:
        """Shrink the image to its latents."""
        x = self.conv_in(x)
        for level in self.down:
            x = level(x)
        return self.conv_out(F.silu(self.norm_out(self.mid(x))))


class ConvolutionalDecoder(Network):
    """The network from latents (B, code_dim, h, w) to the channels of an image."""

    conv_in: Convolution
    mid: nn.Module
    up: nn.ModuleList
    norm_out: nn.Module
    conv_out: Convolution

    def forward(self, z: Float[Tensor, "B D h w"]) -> Float[Tensor, "B heads H W"]:
        """Grow the latents to an image."""
        return self.conv_out(self.features(z))

    def features(self, z: Float[Tensor, "B D h w"]) -> Float[Tensor, "B C H W"]:
        """Return the feature maps that the last convolution reads, at the image's full resolution, in 32 bits."""
        x = self.mid(self.conv_in(z.to(self.conv_in.weight)))
        for level in reversed(self.up):  # the references number their levels from the finest
            x = level(x)
        return F.silu(self.norm_out(x.to(self.conv_out.weight.dtype)))


class ConvolutionalTokenizer(CodebookTokenizer[Config]):
    """A VQ-VAE: encoder, 1x1 convolution, codebook, 1x1 convolution, decoder."""

    encoder: ConvolutionalEncoder
    quant_conv: nn.Conv2d
    post_quant_conv: nn.Conv2d

    def _add_codebook(self, num_codes: int, code_dim: int, loss: CodebookLoss, restart_dead: bool) -> None:
        """Make what lies between encoder and decoder."""
        self.num_codes = num_codes
        self.quantize = VectorQuantiser(num_codes, code_dim, loss, restart_dead)
        self.quant_conv, self.post_quant_conv = (nn.Conv2d(code_dim, code_dim, 1) for _ in range(2))

    @abstractmethod
    def _encoded(self, images: RangeImage) -> Float[Tensor, "B C H W"]:
        """Map the images of a batch to the encoder's input channels."""

    def latents(self, images: RangeImage) -> Float[Tensor, "B D h w"]:
        """Return the continuous latents of a batch, before quantisation."""
        if images.range_m.ndim != 3:
            raise ConfigError("a single range image", "a batch", "make one with RangeImage.stack([image])")
        return self.quant_conv(self.encoder(self._encoded(images)))

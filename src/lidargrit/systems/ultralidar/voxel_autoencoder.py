"""Voxels ⇄ a grid of tokens seen from above: UltraLiDAR's encoder, codebook and decoder.

Names of weights are those of the program's networks, but for blocks, which are nested once less.

Source:
    Xiong et al., UltraLiDAR: Learning Compact Representations for LiDAR Completion and Generation, CVPR 2023; layers as
    in myc634/UltraLiDAR_nusc_waymo@eb65fe0 (MIT), which is not by the authors.
"""

from dataclasses import dataclass, field
from typing import Annotated

import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from lidargrit.core.configuration import Settings
from lidargrit.core.errors import ConfigError
from lidargrit.core.typed_values import Bounds, Count
from lidargrit.nn.blocks import Network
from lidargrit.nn.codebook import Quantised, VectorQuantiser
from lidargrit.nn.flops import flops_of
from lidargrit.systems.ultralidar.swin import SwinConfig, initialise_linear, sine_cosine_positions, swin_blocks
from lidargrit.systems.ultralidar.voxels import VoxelGrid

_EMPTY_AT_FIRST = -3.0  # bias of the logits of occupancy: before training a voxel is occupied with 5 %


@dataclass(frozen=True)
class VoxelAutoencoderConfig(Settings):
    """Cells, tokens and networks of the first stage; the defaults are the program's for KITTI-360.

    Args:
        grid: cells of the box about the sensor.
        patch: number of cells along x and along y that one token stands for, with all cells above each other.
        blocks: sizes of the encoder, and of the decoder.
    """

    grid: VoxelGrid = field(default_factory=VoxelGrid)
    patch: Count = 8
    blocks: SwinConfig = field(default_factory=SwinConfig)
    num_codes: Annotated[int, Bounds(2)] = 1024
    code_dim: Count = 1024

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.grid.cells[0] % self.patch or self.grid.cells[1] % self.patch:
            raise ConfigError(
                f"patch={self.patch} of {self.grid.cells[0]}x{self.grid.cells[1]} cells",
                "a number that divides both",
                "change the patch or the cells",
            )

    @property
    def tokens(self) -> tuple[int, int]:
        """Number of tokens along y and along x."""
        return self.grid.cells[1] // self.patch, self.grid.cells[0] // self.patch


class VoxelAutoencoder(nn.Module):
    """Encoder, codebook and decoder of voxels."""

    def __init__(self, config: VoxelAutoencoderConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder = VoxelEncoder(config)
        self.pre_quant = nn.Sequential(nn.Linear(config.code_dim, config.code_dim), nn.LayerNorm(config.code_dim))
        self.quantiser = VectorQuantiser(config.num_codes, config.code_dim, "vqvae", restart_dead=False)
        self.decoder = VoxelDecoder(config)
        self.pre_quant.apply(initialise_linear)

    def quantise(self, voxels: Float[Tensor, "B z y x"]) -> tuple[Quantised, Float[Tensor, "B T D"]]:
        """Return the quantised latents of scans, and the latents before quantisation."""
        latents = self.pre_quant(self.encoder(voxels))
        return self.quantiser(latents.transpose(1, 2).unflatten(2, self.config.tokens)), latents

    def tokens(self, voxels: Float[Tensor, "B z y x"]) -> Int[Tensor, "B T"]:
        """Return the tokens of scans, row by row: first along x, then along y."""
        return self.quantise(voxels)[0].tokens.flatten(1)

    def codes(self, tokens: Int[Tensor, "B T"]) -> Float[Tensor, "B T D"]:
        """Return the codes of tokens."""
        return self.quantiser.embedding(tokens)

    def sample_voxels(self, tokens: Int[Tensor, "B T"], uniform: Float[Tensor, "B z y x"]) -> Bool[Tensor, "B z y x"]:
        """Return voxels, each occupied with the probability that the decoder gives it.

        Args:
            tokens: tokens of each scan.
            uniform: random numbers from 0 to 1, one for each voxel.
        """
        return occupied_at_random(self.decoder(self.codes(tokens)), uniform)

    def encoding_flops(self) -> int:
        """Return the operations of turning one scan's voxels into tokens."""
        size, length = self.config, self.config.tokens[0] * self.config.tokens[1]
        distances = 2 * length * size.num_codes * size.code_dim
        return (
            flops_of(self.encoder, (1, *size.grid.shape))
            + flops_of(self.pre_quant, (1, length, size.code_dim))
            + distances
        )

    def decoding_flops(self) -> int:
        """Return the operations of turning one scan's tokens into logits of voxels."""
        return flops_of(self.decoder, (1, self.config.tokens[0] * self.config.tokens[1], self.config.code_dim))


class VoxelEncoder(Network):
    """Voxels → a latent for every patch, seen from above."""

    pos_embed: Tensor

    def __init__(self, config: VoxelAutoencoderConfig) -> None:
        super().__init__()
        width = config.blocks.width
        self.patch_embed = _Patches(config.grid.cells[2], config.patch, width)
        self.blocks = swin_blocks(config.blocks, config.tokens)
        self.register_buffer("pos_embed", sine_cosine_positions(config.tokens, width), persistent=False)
        self.norm = nn.Sequential(nn.LayerNorm(width), nn.GELU())
        self.pre_quant = nn.Linear(width, config.code_dim)
        self.apply(initialise_linear)

    def forward(self, voxels: Float[Tensor, "B z y x"]) -> Float[Tensor, "B T D"]:
        """Return the latents, row by row."""
        return self.pre_quant(self.norm(self.blocks(self.patch_embed(voxels) + self.pos_embed)))


class VoxelDecoder(Network):
    """Codes → logits of the probability that each voxel is occupied."""

    pos_embed: Tensor

    def __init__(self, config: VoxelAutoencoderConfig) -> None:
        super().__init__()
        width = config.blocks.width
        self._cut = (*config.tokens, config.patch, config.patch, config.grid.cells[2])
        self.decoder_embed = nn.Linear(config.code_dim, width)
        self.blocks = swin_blocks(config.blocks, config.tokens)
        self.register_buffer("pos_embed", sine_cosine_positions(config.tokens, width), persistent=False)
        self.norm = nn.Sequential(nn.LayerNorm(width), nn.GELU())
        self.pred = nn.Linear(width, config.patch**2 * config.grid.cells[2])
        self.apply(initialise_linear)
        nn.init.constant_(self.pred.bias, _EMPTY_AT_FIRST)

    def forward(self, codes: Float[Tensor, "B T D"]) -> Float[Tensor, "B z y x"]:
        """Return the logits."""
        cells = self.pred(self.norm(self.blocks(self.decoder_embed(codes) + self.pos_embed)))
        rows, columns, side_y, side_x, height = self._cut
        cut = cells.view(len(cells), rows, columns, side_y, side_x, height)
        return cut.permute(0, 5, 1, 3, 2, 4).flatten(4, 5).flatten(2, 3)


class _Patches(nn.Module):
    def __init__(self, height: int, patch: int, width: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(height, width, patch, patch)
        self.norm = nn.LayerNorm(width)

    def forward(self, voxels: Tensor) -> Tensor:
        return self.norm(self.proj(voxels).flatten(2).transpose(1, 2))


def reconstruction_loss(
    logits: Float[Tensor, "B z y x"], voxels: Float[Tensor, "B z y x"]
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Return 100 times the binary cross-entropy of a voxel, and the intersection over union at a probability of 0.5."""
    found, real = logits.detach() > 0, voxels > 0.5
    overlap = (found & real).sum() / (found | real).sum().clamp(min=1)
    return 100 * F.binary_cross_entropy_with_logits(logits.float(), voxels.float()), overlap


def occupied_at_random(logits: Float[Tensor, "B z y x"], uniform: Float[Tensor, "B z y x"]) -> Bool[Tensor, "B z y x"]:
    """Return voxels that are occupied with their probability: where the logit and logistic noise are above 0."""
    return logits + uniform.log() - (1 - uniform).log() > 0

"""UltraLiDAR: voxels seen from above as tokens, filled in by a transformer in a few passes."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from lidargrit.core.configuration import Settings
from lidargrit.core.typed_values import Bounds
from lidargrit.generation.batches import BatchSeeds, check_seeds
from lidargrit.generation.encoding_cache import Frozen
from lidargrit.generation.facts import Cost, SystemFacts
from lidargrit.generation.generator import Generator
from lidargrit.generation.objective import Objective
from lidargrit.nn.collectives import of_first_process, sample_from_all, sum_over_processes
from lidargrit.nn.flops import flops_of
from lidargrit.nn.precision import in_full, inference
from lidargrit.nn.random import gumbel_of, sample_index
from lidargrit.scans.condition import Condition
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage
from lidargrit.systems.ultralidar.swin import SwinConfig
from lidargrit.systems.ultralidar.ultralidar_checkpoint import read_ultralidar_checkpoint
from lidargrit.systems.ultralidar.voxel_autoencoder import VoxelAutoencoder, VoxelAutoencoderConfig, reconstruction_loss
from lidargrit.systems.ultralidar.voxel_prior import (
    FillSampling,
    VoxelPrior,
    generate_tokens,
    hidden_at_random,
    hidden_token_loss,
)
from lidargrit.systems.ultralidar.voxels import VoxelGrid, VoxelVariant, images_of_voxels, voxels_of_images

_LATENTS_PER_CODE = 10  # in the reservoir
_NEW_SHARE = 0.01  # of the reservoir, taken in at every step
_IDLE_STEPS, _IDLE_SHARE = 256, 0.03  # a code is idle after so many steps without use; so many idle codes start k-means
_REST_STEPS = 1000  # between two k-means
_ROUNDS = 50  # of k-means


class CodebookRestart(nn.Module):
    """Watches how a codebook is used in training, and moves its codes when too many lie idle.

    The latents of the last hundred steps are kept as a reservoir. When more than 3 % of the codes have not been chosen
    for 256 steps, k-means over the reservoir begins at the codes in use, and at random latents in place of the idle
    ones. It is done at most every 1,000 steps.

    Source:
        myc634/UltraLiDAR_nusc_waymo@eb65fe0 (MIT). Its counter of idle steps begins at 0, as here, so that its k-means
        of the start comes after 256 steps.
    """

    reservoir: Tensor
    filled: Tensor
    idle_steps: Tensor
    rest_steps: Tensor

    def __init__(self, num_codes: int, code_dim: int) -> None:
        super().__init__()
        self.register_buffer("reservoir", torch.zeros(_LATENTS_PER_CODE * num_codes, code_dim))
        self.register_buffer("filled", torch.tensor(0))  # newest rows of the reservoir that hold a latent
        self.register_buffer("idle_steps", torch.zeros(num_codes, dtype=torch.long))
        self.register_buffer("rest_steps", torch.tensor(0))  # until k-means may be done again

    @torch.no_grad()
    def update(
        self,
        codes: Float[Tensor, "K D"],
        latents: Float[Tensor, "n D"],
        tokens: Int[Tensor, "n"],
        rng: torch.Generator | None,
    ) -> None:
        """Take in the latents of a step, and move the codes, in place, if it is time.

        Args:
            codes: codes of the codebook, changed in place.
            latents: latents of the step, of this process.
            tokens: index of the code that each of them chose.
        """
        counts = torch.zeros(len(codes), device=codes.device).index_add_(0, tokens, torch.ones_like(tokens).float())
        used = sum_over_processes(counts) > 0
        self.idle_steps.copy_(torch.where(used, 0, self.idle_steps + 1))
        new = sample_from_all(latents.float(), max(1, round(_NEW_SHARE * len(self.reservoir))), rng)
        self.reservoir.copy_(torch.cat((self.reservoir, new))[len(new) :])
        self.filled.copy_((self.filled + len(new)).clamp(max=len(self.reservoir)))
        self.rest_steps.copy_((self.rest_steps - 1).clamp(min=0))
        idle = self.idle_steps >= _IDLE_STEPS
        if idle.is_meta:  # without values, where operations are only counted: k-means is rare
            return
        if int(self.rest_steps) == 0 and float(idle.float().mean()) > _IDLE_SHARE:
            with in_full(codes.device):  # codes lie too close together for 16 bits
                codes.copy_(of_first_process(self._moved(codes, idle, rng)))
            self.idle_steps.zero_()
            self.rest_steps.fill_(_REST_STEPS)

    def _moved(self, codes: Tensor, idle: Bool[Tensor, "K"], rng: torch.Generator | None) -> Float[Tensor, "K D"]:
        latents = self.reservoir[-int(self.filled) :]
        centres = torch.where(idle[:, None], sample_from_all(latents, len(codes), rng), codes)
        for _ in range(_ROUNDS):
            nearest = (centres.square().sum(dim=1) - 2 * latents @ centres.T).argmin(dim=1)
            counts = torch.bincount(nearest, minlength=len(centres))[:, None]
            sums = torch.zeros_like(centres).index_add_(0, nearest, latents)
            centres = torch.where(counts > 0, sums / counts.clamp(min=1), centres)
        return centres


_CODEBOOK_WEIGHT = 10.0  # of the quantiser's loss
_ROUNDS_AT_MOST = 1000


@dataclass(frozen=True)
class UltraLidarConfig(Settings):
    """Cells and networks; the defaults are the program's for KITTI-360, 158,317,312 parameters.

    Args:
        autoencoder: cells, tokens and networks of the first stage.
        prior: sizes of the transformer over the tokens.
        flips: whether training mirrors voxels front to back and left to right, each at random. The program always does,
            so that its scans have no front, and turns them for its scores; without, scans face forward.
    """

    autoencoder: VoxelAutoencoderConfig = field(default_factory=VoxelAutoencoderConfig)
    prior: SwinConfig = field(default_factory=lambda: SwinConfig(blocks=24))
    flips: bool = False


@dataclass(frozen=True)
class VoxelSampling(FillSampling):
    """Settings of filling tokens in, and of turning voxels into scans.

    Args:
        rounds: number of times that a sampled scan is encoded again, half of its tokens hidden and replaced by the
            likeliest ones; 8 are published.
        points: rule by which voxels become ranges. ``exact`` ends every ray at the first occupied voxel, at the range
            of its centre. ``reference`` does the same with the clouds that the program writes, whose x and y are
            swapped, and whose points are lower corners.
    """

    rounds: Annotated[int, Bounds(0, _ROUNDS_AT_MOST)] = 8
    points: VoxelVariant = "exact"


class UltraLidar(Generator[UltraLidarConfig, VoxelSampling]):
    """Samples the tokens of voxels by MaskGIT, without those of empty space at first, then voxels at random.

    It learns from the voxels that hold a return of a training image, and turns the voxels that it samples into images
    along the sensor's rays. :meth:`sample_voxels` gives the voxels themselves.

    Source:
        Xiong et al., UltraLiDAR: Learning Compact Representations for LiDAR Completion and Generation, CVPR 2023;
        numbers from myc634/UltraLiDAR_nusc_waymo@eb65fe0 (MIT). The authors' own program was never released.
    """

    Config = UltraLidarConfig
    trains = (("autoencoder", "autoencoder"), ("prior", "prior"))
    facts = SystemFacts(
        generates="occupied voxels; as range images, the first on each ray, with no return where a ray meets none",
        paper="Xiong et al., UltraLiDAR: Learning Compact Representations for LiDAR Completion and Generation, "
        "CVPR 2023",
        program="myc634/UltraLiDAR_nusc_waymo@eb65fe0 (MIT), not by the authors",
        weights_licence="MIT, as the program",
    )
    Sampling = VoxelSampling
    capabilities = frozenset({"encode"})
    published_files = ("checkpoint",)

    def __init__(self, config: UltraLidarConfig, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        sizes = config.autoencoder
        self.autoencoder = VoxelAutoencoder(sizes)
        self.prior = VoxelPrior(config.prior, sizes.tokens, sizes.num_codes, sizes.code_dim)

    @classmethod
    def smallest_config(cls, sensor: SensorModel) -> UltraLidarConfig:
        """Return 4x4 tokens of cells of 3 m, and networks of one block."""
        grid = VoxelGrid(cell_m=(3.125, 3.125, 1.0), cells=(32, 32, 6))
        blocks = SwinConfig(width=16, heads=2, blocks=1)
        return UltraLidarConfig(VoxelAutoencoderConfig(grid, 8, blocks, num_codes=32, code_dim=8), blocks)

    @classmethod
    def quickest_sampling(cls) -> VoxelSampling:
        """Return 4 passes and one round."""
        return VoxelSampling(steps=4, rounds=1)

    def objective(self, stage: str) -> Objective:
        """Return the reconstruction of voxels, or the likelihood of hidden tokens over the frozen autoencoder."""
        if stage == "autoencoder":
            return VoxelReconstruction(self.autoencoder, self.sensor, self.config.flips)
        return HiddenVoxelTokens(self.autoencoder, self.prior, self.sensor, self.config.flips)

    @inference()
    def sample_voxels(self, seeds: Sequence[int], sampling: VoxelSampling | None = None) -> Bool[Tensor, "B z y x"]:
        """Return the occupied voxels of new scans: those whose range images :meth:`sample` returns.

        ``lidargrit.systems.ultralidar.voxels.points_of_voxels`` makes points of them; the cells are those of
        ``config.autoencoder.grid``.
        """
        check_seeds(seeds)
        settings = self._settings(sampling, self.Sampling)
        self.eval()
        return torch.cat([self._voxels(int(seed), settings) for seed in seeds])

    def _sample(self, seeds: BatchSeeds, condition: Condition, sampling: VoxelSampling) -> RangeImage:
        occupied = torch.cat([self._voxels(seed, sampling) for seed in seeds[: seeds.num_asked_for]])
        return self._images(occupied, sampling.points)

    def _reconstruct(self, images: RangeImage) -> RangeImage:
        """Return what the tokens keep of a batch of scans; a voxel is occupied if that is likelier than not."""
        grid = self.config.autoencoder.grid
        found = []
        for index in range(len(images)):
            tokens = self.autoencoder.tokens(voxels_of_images(images[[index]], grid).float())
            found.append(self._images(self.autoencoder.decoder(self.autoencoder.codes(tokens)) > 0, "exact"))
        return RangeImage.cat(found)

    def cost(self, sampling: VoxelSampling | None = None) -> Cost:
        """Return the passes through prior, decoder and encoder, with the search for the nearest codes."""
        sampling, rounds = sampling or VoxelSampling(), (sampling or VoxelSampling()).rounds
        (rows, columns), code_dim = self.config.autoencoder.tokens, self.config.autoencoder.code_dim
        flops = (sampling.steps + rounds) * flops_of(self.prior, (1, rows * columns, code_dim))
        flops += (1 + rounds) * self.autoencoder.decoding_flops() + rounds * self.autoencoder.encoding_flops()
        return Cost(sampling.steps + 1 + 3 * rounds, flops)

    @classmethod
    def read_published(
        cls, files: Sequence[Path], config: UltraLidarConfig, sensor: SensorModel
    ) -> tuple[UltraLidarConfig, dict[str, dict[str, Tensor]]]:
        """Read one checkpoint, which tells its own sizes, but not where its cells lie.

        The grid of the configuration must have as many cells as the file's.
        """
        autoencoder, prior, weights = read_ultralidar_checkpoint(files[0], config.autoencoder)
        return UltraLidarConfig(autoencoder, prior, config.flips), {"": weights}

    def _voxels(self, seed: int, sampling: VoxelSampling) -> Bool[Tensor, "1 z y x"]:
        """Sample one scan; seeds do not share a pass, so that none depends on another's."""
        rng = torch.Generator().manual_seed(seed)  # on the CPU: the same numbers on every device
        shape = (1, *self.config.autoencoder.grid.shape)
        length = self.prior.pos_embed.shape[1]

        def uniform(*size: int) -> Tensor:
            return torch.rand(size, generator=rng).to(self.device)

        def gumbel() -> Tensor:
            return gumbel_of(uniform(1, length))

        start = torch.zeros(1, length, dtype=torch.long, device=self.device)
        tokens = generate_tokens(
            self._logits, start, lambda logits: sample_index(logits, uniform(1, length)), gumbel, sampling
        )
        occupied = self.autoencoder.sample_voxels(tokens, uniform(*shape))
        for _ in range(sampling.rounds):
            tokens = self.autoencoder.tokens(occupied.float())
            hidden = hidden_at_random(uniform(1, length), 0.5)
            tokens = torch.where(hidden, self._logits(tokens, hidden).argmax(dim=-1), tokens)
            occupied = self.autoencoder.sample_voxels(tokens, uniform(*shape))
        return occupied

    def _logits(self, tokens: Int[Tensor, "B T"], hidden: Bool[Tensor, "B T"]) -> Float[Tensor, "B T K"]:
        return self.prior(self.prior.hide(self.autoencoder.codes(tokens), hidden))

    def _images(self, occupied: Bool[Tensor, "B z y x"], points: VoxelVariant) -> RangeImage:
        return images_of_voxels(occupied, self.config.autoencoder.grid, self.sensor, points)


class VoxelReconstruction(Objective):
    """The first stage's objective: cross-entropy of voxels, and the distance of codes and latents."""

    def __init__(self, autoencoder: VoxelAutoencoder, sensor: SensorModel, flips: bool) -> None:
        super().__init__(sensor)
        self.autoencoder, self._flips = autoencoder, flips
        self.care = CodebookRestart(autoencoder.config.num_codes, autoencoder.config.code_dim)

    def forward(self, example: Example, rng: torch.Generator, player: str = "") -> dict[str, Tensor]:
        """Return 100 times a voxel's error and 10 times its code's as ``loss``; beside it both, and the IoU."""
        images = example.images
        voxels = _training_voxels(images, self.autoencoder.config.grid, self._flips, rng)
        quantised, latents = self.autoencoder.quantise(voxels)
        logits = self.autoencoder.decoder(quantised.latents.flatten(2).transpose(1, 2))
        reconstruction, overlap = reconstruction_loss(logits, voxels)
        if self.training:
            codes = self.autoencoder.quantiser.embedding.weight
            self.care.update(codes, latents.detach().flatten(0, 1), quantised.tokens.flatten(), rng)
        terms = {"voxel_loss": reconstruction.detach(), "codebook_loss": quantised.loss.detach(), "iou": overlap}
        return {"loss": reconstruction + _CODEBOOK_WEIGHT * quantised.loss, **terms}

    def warnings(self) -> list[str]:
        """Return a line if few codes are in effective use."""
        return self.autoencoder.quantiser.warnings("more scans, or a lower model.autoencoder.num_codes")


class HiddenVoxelTokens(Objective):
    """The second stage's objective: cross-entropy of hidden tokens given those shown, with smoothed labels."""

    over = ("autoencoder",)

    def __init__(self, autoencoder: VoxelAutoencoder, prior: VoxelPrior, sensor: SensorModel, flips: bool) -> None:
        super().__init__(sensor)
        self.prior, self._flips = prior, flips
        self._frozen = Frozen(autoencoder)

    def forward(self, example: Example, rng: torch.Generator, player: str = "") -> dict[str, Tensor]:
        """Return the error in nats for each hidden token, of which a batch hides one share, and how many are right."""
        images = example.images
        autoencoder = self._frozen.network(images.range_m.device)
        voxels = _training_voxels(images, autoencoder.config.grid, self._flips, rng)
        with torch.no_grad(), in_full(voxels.device):  # tokens as outside of training
            tokens = autoencoder.tokens(voxels)
            codes = autoencoder.codes(tokens)
        progress = torch.rand((), generator=rng, device=rng.device, dtype=torch.float64)
        noise = torch.rand(tokens.shape, generator=rng, device=rng.device)
        hidden = hidden_at_random(noise, (progress * (torch.pi / 2)).cos())
        logits = self.prior(self.prior.hide(codes, hidden))
        right = ((logits.detach().argmax(dim=-1) == tokens) & hidden).sum() / hidden.sum()
        return {"loss": hidden_token_loss(logits, tokens, hidden), "accuracy": right}


def _training_voxels(
    images: RangeImage, grid: VoxelGrid, flips: bool, rng: torch.Generator
) -> Float[Tensor, "B z y x"]:
    """Return the voxels of a batch, each scan's mirrored along x and along y at random if that is wanted."""
    voxels = voxels_of_images(images, grid)
    if flips:
        coins = torch.rand(2, len(voxels), 1, 1, 1, generator=rng, device=rng.device) < 0.5
        for axis, coin in zip((-1, -2), coins, strict=True):
            voxels = torch.where(coin, voxels.flip(axis), voxels)
    return voxels.float()

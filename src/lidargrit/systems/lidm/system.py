"""LiDM: a diffusion model over the latents of a VQ autoencoder, LiDM's own or LidarGRIT's; seeds → range images."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor, nn

from lidargrit.core.configuration import Settings
from lidargrit.core.errors import CheckpointError, ConfigError
from lidargrit.core.typed_values import Bounds, Share
from lidargrit.generation.encoding_cache import EncodingCache
from lidargrit.generation.facts import Cost, SamplingSettings, SystemFacts
from lidargrit.generation.generator import Generator
from lidargrit.generation.objective import Objective
from lidargrit.generation.tokenizers import CodebookTokenizer, Tokenizer, TokenizerConfig, make_tokenizer
from lidargrit.generation.tokenizers.curve_vqvae import CurveVqvaeConfig
from lidargrit.nn.flops import flops_of
from lidargrit.nn.published import read_checkpoint, weights_below
from lidargrit.nn.random import SeededNoise, rngs_of
from lidargrit.scans.condition import Condition
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import MaskDecoding, RangeImage
from lidargrit.systems.lidm import latent_diffusion
from lidargrit.systems.lidm.latent_unet import LatentUnet, LatentUnetConfig

_LEAST_SHARE = 1e-3  # of the largest variance: axes along which codes do not differ are not blown up
_LEAST_VARIANCE = 1e-12  # where one code is all that is used


class LatentAxes(nn.Module):
    """The axes along which the codes of a codebook differ most, each in its own standard deviation.

    Codes may differ along a few of their axes only; noise of one size in all channels then hides little of what they
    say, and most of a network's loss is spent on channels that say nothing.

    Args:
        code_dim: number of channels of a latent.
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


_PUBLISHED_BYTES_AT_MOST = 1 << 32  # the authors' file has 3.9 GB, by their README
_FIRST_STAGE, _RAW, _AVERAGE = "first_stage_model.", "model.diffusion_model.", "model_ema."
_NOT_READ = (f"{_FIRST_STAGE}loss.*", f"{_AVERAGE}decay", f"{_AVERAGE}num_updates", "cond_stage_model.*", "loss.*")


@dataclass(frozen=True)
class LidmConfig(Settings):
    """The two networks; the defaults are the published ones.

    Args:
        tokenizer: configuration of a tokenizer with a codebook; ``curve_vqvae`` is LiDM's own, ``vqvae`` LidarGRIT's.
        denoiser: sizes of the network that removes noise from its latents.
        scale_latents: whether latents are divided by the standard deviation of the codebook's numbers before noise is
            added. LiDM takes its own latents as they are; those of another tokenizer may be of any size.
        latent_axes: number of principal axes of the codebook along which noise is added and removed, each divided by
            its own standard deviation; 0 takes the channels of the latents as they are.
    """

    tokenizer: TokenizerConfig = field(default_factory=CurveVqvaeConfig)
    denoiser: LatentUnetConfig = field(default_factory=LatentUnetConfig)
    scale_latents: bool = False
    latent_axes: int = 0


@dataclass(frozen=True)
class LidmSampling(SamplingSettings):
    """Settings of sampling latents and returns.

    Args:
        steps: number of evaluations of the network; 50 are published.
        eta: share of each step's noise that is fresh: 1 in the authors' ``sample.py``, 0 for none after the beginning.
        mask: method by which returns are decided where the tokenizer gives their probability. ``bernoulli`` samples
            each return, ``threshold`` keeps one that is at least as likely as not. LiDM's tokenizer gives none.
    """

    steps: Annotated[int, Bounds(1, latent_diffusion.STEPS_AT_MOST)] = 50
    eta: Share = 1.0
    mask: MaskDecoding = "bernoulli"


class Lidm(Generator[LidmConfig, LidmSampling]):
    """Samples latents by diffusion, replaces each by its nearest code, and decodes them.

    The tokenizer is trained first, then the denoiser over the frozen tokenizer. The authors' models with conditions
    (semantic maps, cameras, text) are not here.

    Source:
        Ran et al., Towards Realistic Scene Generation with LiDAR Diffusion Models, CVPR 2024; numbers from
        hancyran/LiDAR-Diffusion@8416ddb (MIT).
    """

    Config = LidmConfig
    trains = (("tokenizer", "tokenizer"), ("denoiser", "denoiser"))
    facts = SystemFacts(
        generates="range and raydrop, the latter as its tokenizer decodes it",
        paper="Ran et al., Towards Realistic Scene Generation with LiDAR Diffusion Models, CVPR 2024",
        program="hancyran/LiDAR-Diffusion@8416ddb (MIT)",
        weights_licence="MIT, as the program",
    )
    Sampling = LidmSampling
    capabilities = frozenset({"tokens", "encode"})
    published_files = ("first stage and diffusion model",)
    latent_scale: Tensor

    def __init__(self, config: LidmConfig, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        tokenizer = make_tokenizer(config.tokenizer, sensor)
        if not isinstance(tokenizer, CodebookTokenizer):
            raise ConfigError(
                f"a tokenizer {config.tokenizer.name()!r} for lidm", "one with a codebook", "e.g. curve_vqvae or vqvae"
            )
        self.tokenizer = tokenizer
        code_dim, axes = tokenizer.quantize.embedding.embedding_dim, config.latent_axes
        if not 0 <= axes <= code_dim or (axes and config.scale_latents):
            got = f"latent_axes={axes}, scale_latents={config.scale_latents} for latents of {code_dim} channels"
            raise ConfigError(got, "0 to as many axes, and one of the two", "correct them")
        self.axes = LatentAxes(code_dim, axes) if axes else None
        self.latent_shape = (axes or code_dim, *tokenizer.grid_size)
        self.denoiser = LatentUnet(config.denoiser, self.latent_shape[0], tokenizer.grid_size)
        self.register_buffer("latent_scale", torch.ones(()))

    @classmethod
    def smallest_config(cls, sensor: SensorModel) -> LidmConfig:
        """Return an autoencoder and a U-Net of two levels, 32 channels and one block a level."""
        tokenizer = CurveVqvaeConfig(32, (1, 1), (2,), 1, code_dim=4, num_codes=32, range_scale=7.0)
        return LidmConfig(tokenizer, LatentUnetConfig(32, (1, 1), 1, ()))

    @classmethod
    def quickest_sampling(cls) -> LidmSampling:
        """Return 2 steps."""
        return LidmSampling(steps=2)

    def objective(self, stage: str) -> Objective:
        """Return the tokenizer itself, or the denoising of its latents."""
        if stage == "tokenizer":
            return self.tokenizer
        scale = self.tokenizer.quantize.spread() if self.config.scale_latents else self.latent_scale
        axes = copy.deepcopy(self.axes)
        if axes is not None:
            axes.fit(self.tokenizer.quantize.embedding.weight, self.tokenizer.quantize.share())
        return LatentDenoising(self.tokenizer, self.denoiser, scale, axes)

    def load_stage(self, stage: str, objective: Objective) -> None:
        """Take over a stage's trained weights, and the scale or the axes of the latents that it saw."""
        super().load_stage(stage, objective)
        if isinstance(objective, LatentDenoising):
            self.latent_scale.copy_(objective.latent_scale)
            if self.axes is not None and objective.axes is not None:
                self.axes.load_state_dict(objective.axes.state_dict())

    def get_tokenizer(self) -> Tokenizer:
        """Return the tokenizer, from whose codes every sampled scan is decoded."""
        return self.tokenizer

    def _reconstruct(self, images: RangeImage) -> RangeImage:
        """Return what the tokens keep of a batch of scans, the mask by threshold."""
        return self.tokenizer.reconstruct(images)

    def _sample(self, seeds: Sequence[int], condition: Condition, sampling: LidmSampling) -> RangeImage:
        noise = SeededNoise(seeds, self.latent_shape, self.device)
        latents = latent_diffusion.ddim(self.denoiser, noise, sampling.steps, sampling.eta)
        latents = latents * self.latent_scale if self.axes is None else self.axes.latents(latents)
        decoding = self.tokenizer.for_decoding("fp32")
        return decoding.sample(self.tokenizer.quantised(latents), rngs_of(seeds), sampling.mask)

    def cost(self, sampling: LidmSampling | None = None) -> Cost:
        """Return the denoiser's passes, one a step, and one of the decoder."""
        steps = (sampling or LidmSampling()).steps
        flops = steps * flops_of(self.denoiser, (1, *self.latent_shape), (1,)) + self.tokenizer.decoding_flops()
        return Cost(steps + 1, flops)

    @classmethod
    def read_published(
        cls, files: Sequence[Path], config: LidmConfig, sensor: SensorModel
    ) -> tuple[LidmConfig, dict[str, dict[str, Tensor]]]:
        """Read one checkpoint, which holds both networks and tells whether there is a mask channel.

        Other sizes are the configuration's. The moving average of the denoiser's weights is taken, or the weights
        themselves where the file has none. No file of the authors could be tried: the layout is their program's.
        """
        (path,) = files
        found = read_checkpoint(path, ("state_dict",), _PUBLISHED_BYTES_AT_MOST, _NOT_READ)
        first_stage, denoiser = weights_below(found, _FIRST_STAGE), weights_below(found, _RAW)
        last_layer = first_stage.get("decoder.conv_out.weight")
        if last_layer is None or last_layer.ndim != 4 or not isinstance(config.tokenizer, CurveVqvaeConfig):
            raise CheckpointError(
                f"{path}, which holds no decoder of a tokenizer {config.tokenizer.name()!r}",
                "a checkpoint of LiDM's diffusion model, which holds its first stage too",
                "check the path, and use the preset lidm_kitti_360",
            )
        if averaged := weights_below(found, _AVERAGE):  # under the same names without dots
            names = {f"diffusion_model{name.replace('.', '')}": name for name in denoiser}
            denoiser = {names.get(name, name): tensor for name, tensor in averaged.items()}
        tokenizer = replace(config.tokenizer, mask_head=len(last_layer) > 1)
        read = replace(config, tokenizer=tokenizer, scale_latents=False)
        return read, {"tokenizer": first_stage, "denoiser": denoiser}


class LatentDenoising(Objective):
    """The objective: the squared error of the predicted noise in the latents of a frozen tokenizer, at random steps."""

    over = ("tokenizer",)
    keeps_encodings = True
    settings = ("scale_latents", "latent_axes")
    latent_scale: Tensor
    _shares: Tensor

    def __init__(
        self,
        tokenizer: CodebookTokenizer,
        denoiser: LatentUnet,
        latent_scale: Float[Tensor, ""],
        axes: LatentAxes | None = None,
    ) -> None:
        super().__init__(tokenizer.sensor)
        self.denoiser = denoiser
        self._latents = EncodingCache(tokenizer, _latents)
        self.axes = axes
        self.register_buffer("_shares", latent_diffusion.signal_shares(), persistent=False)
        self.register_buffer("latent_scale", latent_scale.clone())

    def forward(self, example: Example, rng: torch.Generator, player: str = "") -> dict[str, Tensor]:
        """Return the mean squared error as ``loss``, and the standard deviation of the scaled latents beside it."""
        latents = self._latents(example.images, example.keys)
        clean = latents / self.latent_scale if self.axes is None else self.axes(latents)
        step = torch.randint(latent_diffusion.TIME_STEPS, (len(clean),), generator=rng, device=clean.device)
        noise = torch.randn(clean.shape, generator=rng, device=clean.device)
        noisy = latent_diffusion.noised(clean, self._shares[step], noise)
        error = (self.denoiser(noisy, step.float()).float() - noise).square().mean()
        return {"loss": error, "latent_std": clean.std()}

    def weights_from(self, trained: Objective) -> dict[str, Tensor]:
        """Return the weights of a trained denoiser, without the scale and the axes of another codebook."""
        weights = super().weights_from(trained)
        if isinstance(trained, LatentDenoising) and not self._has_codebook_of(trained):
            return {name: weight for name, weight in weights.items() if name.startswith("denoiser.")}
        return weights

    def _has_codebook_of(self, other: "LatentDenoising") -> bool:
        own, others = (one._latents.network(one.latent_scale.device).quantize.embedding.weight for one in (self, other))
        return not own.is_meta and torch.equal(own.cpu(), others.cpu())  # without values where a training is planned


def _latents(tokenizer: CodebookTokenizer, images: RangeImage) -> Float[Tensor, "B D h w"]:
    return tokenizer.latents(images).float()

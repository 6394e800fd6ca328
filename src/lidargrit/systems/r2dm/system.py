"""R2DM: a diffusion model of log range and reflectance, raydrop by a window of ranges; seeds → range images."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from lidargrit.core import reporting
from lidargrit.core.configuration import Settings
from lidargrit.core.determinism import evenly_spaced, scan_seed
from lidargrit.core.errors import ConfigError
from lidargrit.core.typed_values import Bounds, NotNegative
from lidargrit.core.untrusted import STEPS_AT_MOST
from lidargrit.data.images import RangeImages
from lidargrit.generation.facts import Cost, SamplingSettings, SystemFacts
from lidargrit.generation.generator import Generator
from lidargrit.generation.objective import Objective
from lidargrit.generation.range_values import decode, encode
from lidargrit.nn.flops import flops_of
from lidargrit.nn.precision import inference
from lidargrit.nn.random import SeededNoise
from lidargrit.scans.condition import Condition, Observed
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage
from lidargrit.systems.r2dm import diffusion
from lidargrit.systems.r2dm.diffusion import Sampler
from lidargrit.systems.r2dm.r2dm_checkpoint import read_r2dm_checkpoint
from lidargrit.systems.r2dm.unet import EfficientUnet, UnetConfig

_BATCH = 8
_SHARE_SCANS = 1000  # whose returns are counted: more would not change their share
_CALIBRATION_SEED = 1 << 40  # mixed with a scan's number, so that its seed is none of a user's first


@dataclass(frozen=True)
class R2dmConfig(Settings):
    """Channels and network of R2DM.

    Args:
        reflectance: whether reflectance is learned beside the range, as published; set it to false where scans have
            none, or for a sharper range (the authors' own remark).
        calibration_scans: number of scans sampled at the end of training to fit the threshold of the ``calibrated``
            raydrop; 0 for none.
    """

    unet: UnetConfig = field(default_factory=UnetConfig)
    reflectance: bool = True
    calibration_scans: NotNegative = 16


@dataclass(frozen=True)
class DiffusionSampling(SamplingSettings):
    """Settings of sampling, and the rule by which a pixel is a return.

    Args:
        steps: number of evaluations of the network; 256 are published, and 32 for completion.
        sampler: ``ddpm`` adds fresh noise after each step (published), ``ddim`` only at the beginning.
        raydrop: rule by which a pixel is a return. ``published``: its range lies inside the sensor's limits.
            ``calibrated`` (not in the paper): its value is above a threshold, fitted so that as many rays return as in
            the training scans; a barely trained model may lose near returns by it.
        resamples: number of times that each step is taken when a scan is completed.
    """

    steps: Annotated[int, Bounds(1, STEPS_AT_MOST)] = 256
    sampler: Sampler = "ddpm"
    raydrop: Literal["published", "calibrated"] = "published"
    resamples: Annotated[int, Bounds(1, STEPS_AT_MOST)] = 16


_CALIBRATION = DiffusionSampling(steps=32)


class R2dm(Generator[R2dmConfig, DiffusionSampling]):
    """Generates the image of log ranges, in which a missing return is a range that no return has.

    Source:
        Nakashima and Kurazume, LiDAR Data Synthesis with Denoising Diffusion Probabilistic Models, ICRA 2024; numbers
        from kazuto1011/r2dm@1c5963d (MIT).
    """

    Config = R2dmConfig
    trains = (("diffusion", "network"),)
    facts = SystemFacts(
        generates="range and reflectance; a range outside the sensor's limits is no return",
        paper="Nakashima and Kurazume, LiDAR Data Synthesis with Denoising Diffusion Probabilistic Models, ICRA 2024",
        program="kazuto1011/r2dm@1c5963d (MIT)",
        weights_licence="MIT, as the program",
    )
    Sampling = DiffusionSampling
    not_of_sampling = frozenset({"resamples"})
    capabilities = frozenset({"complete"})
    published_files = ("settings and network",)
    return_share: Tensor
    return_threshold: Tensor

    def __init__(self, config: R2dmConfig, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        self.shape = (1 + config.reflectance, sensor.height, sensor.width)
        angles = torch.broadcast_tensors(sensor.elevation_rad, sensor.azimuth_rad)
        self.network = EfficientUnet(config.unet, self.shape[0], *(angle.contiguous() for angle in angles))
        self.register_buffer("return_share", torch.tensor(math.nan))
        self.register_buffer("return_threshold", torch.tensor(math.nan))

    @classmethod
    def smallest_config(cls, sensor: SensorModel) -> R2dmConfig:
        """Return a U-Net of two levels and 8 channels."""
        return R2dmConfig(UnetConfig(8, (1, 1), (1, 1), norm_groups=2, attention_heads=2))

    @classmethod
    def quickest_sampling(cls) -> DiffusionSampling:
        """Return 3 steps, each taken twice when a scan is completed."""
        return DiffusionSampling(steps=3, resamples=2)

    @classmethod
    def completion_sampling(cls) -> DiffusionSampling:
        """Return 32 steps with 16 resamples each, as in the authors' demonstration."""
        return DiffusionSampling(steps=32)

    def fit_statistics(self, images: RangeImages) -> None:
        """Count how many of the training scans' rays return."""
        chosen = evenly_spaced(_SHARE_SCANS, len(images))
        shares = [
            images.batch(chosen[first : first + _BATCH]).return_mask.float().mean((1, 2))
            for first in range(0, len(chosen), _BATCH)
        ]
        self.return_share.fill_(float(torch.cat(shares).mean()))

    def objective(self, stage: str) -> Objective:
        """Return the denoising of the network."""
        return Denoising(self.network, self.sensor)

    def after_training(self) -> None:
        """Fit the threshold of the calibrated raydrop: as many values lie above it as rays returned in training."""
        seeds = [scan_seed(_CALIBRATION_SEED, number) for number in range(self.config.calibration_scans)]
        if not seeds or not bool(self.return_share.isfinite()):
            return
        parts = list[Tensor]()
        with inference(), reporting.progress("calibrating raydrop", len(seeds)) as progress:
            for first in range(0, len(seeds), _BATCH):
                parts.append(self._sample_values(seeds[first : first + _BATCH], _CALIBRATION))
                progress.advance(len(parts[-1]))
        levels = torch.cat([part[:, 0].flatten() for part in parts]).sort().values
        dropped = min(round((1 - float(self.return_share)) * len(levels)), len(levels) - 1)
        self.return_threshold.fill_(float(levels[dropped]))

    def _sample(self, seeds: Sequence[int], condition: Condition, sampling: DiffusionSampling) -> RangeImage:
        self._check(sampling)
        return self._decoded(self._sample_values(seeds, sampling), sampling)

    def _complete(self, condition: Observed, seeds: Sequence[int], sampling: DiffusionSampling) -> RangeImage:
        """Generate scans that agree with the observed pixels, by RePaint over DDPM."""
        self._check(sampling)
        if sampling.sampler != "ddpm":
            raise ConfigError(f"sampler={sampling.sampler} for completion", "sampler=ddpm", "RePaint adds fresh noise")
        noise, clean = SeededNoise(seeds, self.shape, self.device), encode(condition.images, self.config.reflectance)
        observed = condition.return_observed[:, None]
        generated = diffusion.repaint(self.network, noise, clean, observed, sampling.steps, sampling.resamples)
        return self._decoded(generated, sampling)

    def cost(self, sampling: DiffusionSampling | None = None) -> Cost:
        """Return the network's passes, one a step."""
        steps = (sampling or DiffusionSampling()).steps
        return Cost(steps, steps * flops_of(self.network, (1, *self.shape), (1,)))

    @classmethod
    def read_published(
        cls, files: Sequence[Path], config: R2dmConfig, sensor: SensorModel
    ) -> tuple[R2dmConfig, dict[str, dict[str, Tensor]]]:
        """Read one checkpoint, which tells its own sizes, in either layout of the authors."""
        unet, reflectance, weights = read_r2dm_checkpoint(files[0])
        return R2dmConfig(unet, reflectance), {"network": weights}

    @torch.no_grad()
    def _sample_values(self, seeds: Sequence[int], sampling: DiffusionSampling) -> Float[Tensor, "B C H W"]:
        self.eval()
        noise = SeededNoise(seeds, self.shape, self.device)
        return diffusion.sample(self.network, noise, sampling.steps, sampling.sampler)

    def _decoded(self, sampled: Float[Tensor, "B C H W"], sampling: DiffusionSampling) -> RangeImage:
        returned = sampled[:, 0] >= self.return_threshold if sampling.raydrop == "calibrated" else None
        return decode(sampled, self.sensor, returned)

    def _check(self, sampling: DiffusionSampling) -> None:
        if sampling.raydrop == "calibrated" and not bool(self.return_threshold.isfinite()):
            raise ConfigError(
                "raydrop=calibrated for a model whose threshold was never fitted",
                "raydrop=published",
                "train with model.calibration_scans above 0",
            )


class Denoising(Objective):
    """The objective: the squared error of the predicted noise at a random time, weighed by min-SNR."""

    ray_buffers = ("network.coords",)

    def __init__(self, network: EfficientUnet, sensor: SensorModel) -> None:
        super().__init__(sensor)
        self.network = network

    def check(self, images: RangeImage) -> None:
        """Refuse images without the reflectance that is to be learned."""
        encode(images, with_reflectance=self.network.out_conv.out_channels > 1)

    def forward(self, example: Example, rng: torch.Generator, player: str = "") -> dict[str, Tensor]:
        """Return the weighed error as ``loss``, and the plain one beside it."""
        images = example.images
        clean = encode(images, with_reflectance=self.network.out_conv.out_channels > 1)
        time = torch.rand(len(clean), generator=rng, device=clean.device, dtype=torch.float64)
        noise = torch.randn(clean.shape, generator=rng, device=clean.device)
        log_snr = diffusion.log_snr_at(time).float()
        predicted = self.network(diffusion.noised(clean, log_snr, noise), log_snr).float()
        error = (predicted - noise).square().mean((1, 2, 3))
        return {"loss": (error * diffusion.min_snr_weight(log_snr)).mean(), "noise_mse": error.mean()}

"""LiDAR-VAE: a variational autoencoder of distance and height in 40 rows without holes; seeds → range images."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from lidargrit.core.configuration import COUNTS_SCANS, Settings
from lidargrit.core.typed_values import Count, NotNegative, Weight
from lidargrit.data.images import RangeImages
from lidargrit.generation.facts import Cost, SamplingSettings, SystemFacts
from lidargrit.generation.generator import Generator
from lidargrit.generation.objective import Objective
from lidargrit.nn.collectives import num_processes
from lidargrit.nn.flops import flops_of
from lidargrit.nn.random import normal_latents
from lidargrit.scans.condition import Condition, Observed
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage
from lidargrit.systems.lidargan.filled_rows import FilledRows
from lidargrit.systems.lidargan.networks import Decoder, Encoder, InitialStd, kl_nats, read_published_sizes, vae_loss


@dataclass(frozen=True)
class LidarVaeConfig(Settings):
    """Networks and objective of the VAE; the defaults are the published ones.

    Args:
        latent_dim: length of a latent; models of 128, 256 and 512 are published.
        channels: number of channels of the finest level of both networks; each of the three coarser levels has twice as
            many.
        rows: number of rows that are encoded and generated: 24, 40, 56 or more in steps of 16.
        first_row: index of the highest of these rows. The program leaves out the highest 17 and the lowest 7 of 64.
        warmup_scans: number of training scans over which the weight of the divergence rises linearly from 0 to 1; 0
            for a weight of 1 from the start.
        free_nats: KL divergence of a scan's latent, in nats, below which it adds nothing to the loss (free bits).
        initial_std: standard deviation of the new weights of both networks.
    """

    latent_dim: Count = 128
    channels: Count = 64
    rows: int = 40
    first_row: int = 17
    warmup_scans: NotNegative = field(default=0, metadata={COUNTS_SCANS: True})
    free_nats: Weight = 5.0
    initial_std: InitialStd = 0.02


@dataclass(frozen=True)
class VaeSampling(SamplingSettings):
    """Settings of completing scans; sampling itself has none.

    Args:
        spread: factor on the standard deviations by which a latent is sampled around the mean latent of the observed
            pixels when a scan is completed; 0 takes the mean, as the paper does in its evaluation.
    """

    spread: Weight = 1.0


class LidarVae(Generator[LidarVaeConfig, VaeSampling]):
    """A variational autoencoder over horizontal distance and height, of scans whose holes were filled.

    Every ray of its rows returns, and no ray of the others: see :attr:`full_rows`. To complete a scan, it fills
    unobserved pixels as it fills other holes, encodes the result and decodes it.

    Source:
        Caccia et al., Deep Generative Modeling of LiDAR Data, IROS 2019; numbers from
        pclucas14/lidar_generation@2a2c8bc.
    """

    Config = LidarVaeConfig
    Sampling = VaeSampling
    not_of_sampling = frozenset({"spread"})
    trains = (("autoencoder", "image", "encode", "decode"),)
    facts = SystemFacts(
        generates="range; every ray of 40 rows returns, and no ray of the others",
        paper="Caccia et al., Deep Generative Modeling of LiDAR Data, IROS 2019",
        program="pclucas14/lidar_generation@2a2c8bc (no licence)",
        weights_licence="no licence stated",
    )
    capabilities = frozenset({"encode", "complete"})
    published_files = ("autoencoder",)

    def __init__(self, config: LidarVaeConfig, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        size = (config.rows, sensor.width)
        self.image = FilledRows(sensor, config.first_row, config.rows)
        self.encode = Encoder(2 * config.latent_dim, config.channels, size, config.initial_std)
        self.decode = Decoder(config.latent_dim, config.channels, size, config.initial_std)

    @classmethod
    def smallest_config(cls, sensor: SensorModel) -> LidarVaeConfig:
        """Return networks of 2 to 16 channels for 24 rows, with weights so large that untrained scans differ."""
        return LidarVaeConfig(latent_dim=4, channels=2, rows=24, first_row=sensor.height - 24, initial_std=0.5)

    @property
    def full_rows(self) -> range:
        """Rows that are generated."""
        return self.image.range

    def fit_statistics(self, images: RangeImages) -> None:
        """Take the scale of the images from the training scans."""
        self.image.fit(images)

    def objective(self, stage: str) -> Objective:
        """Return the objective of both networks."""
        return LidarVaeObjective(self.encode, self.decode, self.image, self.config)

    def _sample(self, seeds: Sequence[int], condition: Condition, sampling: VaeSampling) -> RangeImage:
        return self.image.decode(self.decode(self._latents(seeds)))

    def cost(self, sampling: VaeSampling | None = None) -> Cost:
        """Return one pass of the decoder."""
        return Cost(1, flops_of(self.decode, (1, self.config.latent_dim)))

    def _reconstruct(self, images: RangeImage) -> RangeImage:
        mean, _ = self.encode(self.image.encode(images)).chunk(2, dim=1)
        return self.image.decode(self.decode(mean))

    def _complete(self, condition: Observed, seeds: Sequence[int], sampling: VaeSampling) -> RangeImage:
        mean, log_variance = self.encode(self.image.encode(condition.images)).chunk(2, dim=1)
        latents = mean + sampling.spread * (log_variance / 2).exp() * self._latents(seeds)
        return self.image.decode(self.decode(latents))

    def _latents(self, seeds: Sequence[int]) -> Float[Tensor, "B D"]:
        return normal_latents(seeds, self.config.latent_dim).to(self.device)

    @classmethod
    def read_published(
        cls, files: Sequence[Path], config: LidarVaeConfig, sensor: SensorModel
    ) -> tuple[LidarVaeConfig, dict[str, dict[str, Tensor]]]:
        """Read one file of weights, such as ``gen_299.pth``; see :func:`read_published_sizes`."""
        names = ("decode.main.0", "encode.main.0")
        weights, latent_dim, channels = read_published_sizes(files[0], "autoencoder", *names)
        sizes = (latent_dim, channels, config.rows, config.first_row, config.warmup_scans, config.free_nats)
        return LidarVaeConfig(*sizes), {"": weights}


class LidarVaeObjective(Objective):
    """The VAE's loss: the absolute error of the decoded image, and the divergence of its latent from the prior."""

    scans_seen: Tensor

    def __init__(self, encode: Encoder, decode: Decoder, image: FilledRows, config: LidarVaeConfig) -> None:
        super().__init__(image.sensor)
        self.config, self.encode, self.decode, self.image = config, encode, decode, image
        self.register_buffer("scans_seen", torch.zeros((), dtype=torch.int64))

    def forward(self, example: Example, rng: torch.Generator, player: str = "") -> dict[str, Tensor]:
        """Return the loss and its two parts."""
        images = example.images
        real = self.image.encode(images)
        mean, log_variance = self.encode(real).chunk(2, dim=1)
        latents = mean
        if self.training:
            self.scans_seen += len(real) * num_processes()
            noise = torch.randn(mean.shape, generator=rng, device=rng.device)
            latents = mean + (log_variance / 2).exp() * noise
        weight = (self.scans_seen / max(self.config.warmup_scans, 1)).clamp(max=1.0)
        kl_weight = weight if self.config.warmup_scans else 1.0
        return vae_loss(real, self.decode(latents), kl_nats(mean, log_variance), kl_weight, self.config.free_nats)

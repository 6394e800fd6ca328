"""LidarGAN: a GAN of distance and height in 40 rows without holes; seeds → range images without raydrop."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from torch.func import functional_call

from lidargrit.core.configuration import Settings
from lidargrit.core.typed_values import Count
from lidargrit.data.images import RangeImages
from lidargrit.generation.facts import Cost, SamplingSettings, SystemFacts
from lidargrit.generation.generator import Generator
from lidargrit.generation.objective import Objective
from lidargrit.nn.flops import flops_of
from lidargrit.nn.random import normal_latents
from lidargrit.scans.condition import Condition
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage
from lidargrit.systems.lidargan.filled_rows import FilledRows
from lidargrit.systems.lidargan.networks import Decoder, Encoder, InitialStd, read_published_sizes, relativistic_loss


@dataclass(frozen=True)
class LidarGanConfig(Settings):
    """Networks of LidarGAN; the defaults are the published ones.

    Args:
        channels: number of channels of the finest level of both networks; each of the three coarser levels has twice as
            many.
        rows: number of rows that are generated: 24, 40, 56 or more in steps of 16.
        first_row: index of the highest of these rows. The program leaves out the highest 17 and the lowest 7 of 64.
        initial_std: standard deviation of the new weights of both networks.
    """

    latent_dim: Count = 100
    channels: Count = 64
    rows: int = 40
    first_row: int = 17
    initial_std: InitialStd = 0.02


class LidarGan(Generator[LidarGanConfig, SamplingSettings]):
    """A generative adversarial network over horizontal distance and height, of scans whose holes were filled.

    Every ray of its rows returns, and no ray of the others: see :attr:`full_rows`.

    Source:
        Caccia et al., Deep Generative Modeling of LiDAR Data, IROS 2019; numbers from
        pclucas14/lidar_generation@2a2c8bc.
    """

    Config = LidarGanConfig
    trains = (("adversarial", "image", "decoder"),)
    facts = SystemFacts(
        generates="range; every ray of 40 rows returns, and no ray of the others",
        paper="Caccia et al., Deep Generative Modeling of LiDAR Data, IROS 2019",
        program="pclucas14/lidar_generation@2a2c8bc (no licence)",
        weights_licence="no licence stated",
    )
    published_files = ("generator",)

    def __init__(self, config: LidarGanConfig, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        self.image = FilledRows(sensor, config.first_row, config.rows)
        size = (config.rows, sensor.width)
        self.decoder = Decoder(config.latent_dim, config.channels, size, config.initial_std)

    @classmethod
    def smallest_config(cls, sensor: SensorModel) -> LidarGanConfig:
        """Return networks of 2 to 16 channels for 24 rows, with weights so large that untrained scans differ."""
        return LidarGanConfig(latent_dim=4, channels=2, rows=24, first_row=sensor.height - 24, initial_std=0.5)

    @property
    def full_rows(self) -> range:
        """Rows that are generated."""
        return self.image.range

    def fit_statistics(self, images: RangeImages) -> None:
        """Take the scale of the images from the training scans."""
        self.image.fit(images)

    def objective(self, stage: str) -> Objective:
        """Return the losses of the network and of a discriminator."""
        return LidarGanObjective(self.decoder, self.image, self.config)

    def _sample(self, seeds: Sequence[int], condition: Condition, sampling: SamplingSettings) -> RangeImage:
        latents = normal_latents(seeds, self.config.latent_dim).to(self.device)
        return self.image.decode(self.decoder(latents))

    def cost(self, sampling: SamplingSettings | None = None) -> Cost:
        """Return one pass of the network."""
        return Cost(1, flops_of(self.decoder, (1, self.config.latent_dim)))

    @classmethod
    def read_published(
        cls, files: Sequence[Path], config: LidarGanConfig, sensor: SensorModel
    ) -> tuple[LidarGanConfig, dict[str, dict[str, Tensor]]]:
        """Read one file of weights, such as ``gen_999.pth``; see :func:`read_published_sizes`."""
        weights, latent_dim, channels = read_published_sizes(files[0], "generator", "main.0", "main.12")
        return LidarGanConfig(latent_dim, channels, config.rows, config.first_row), {"decoder": weights}


class LidarGanObjective(Objective):
    """LidarGAN's adversarial losses: two players take turns, with the same real scans and latents.

    The program takes other real scans for the second player.
    """

    players = ("discriminator", "generator")

    def __init__(self, decoder: Decoder, image: FilledRows, config: LidarGanConfig) -> None:
        super().__init__(image.sensor)
        self.config, self.decoder, self.image = config, decoder, image
        size = (config.rows, image.sensor.width)
        self.discriminator = Encoder(1, config.channels, size, config.initial_std)

    def forward(self, example: Example, rng: torch.Generator, player: str = "") -> dict[str, Tensor]:
        """Return a player's loss, and the discriminator's mean output for real and generated images."""
        images = example.images
        real = self.image.encode(images)
        latents = torch.randn(len(real), self.config.latent_dim, generator=rng, device=rng.device)
        if player == "discriminator":
            with torch.no_grad():
                generated = self.decoder(latents)
            of_real, of_generated = self._judged(real, {}), self._judged(generated, {})
            loss = relativistic_loss(of_real, of_generated)
        else:
            frozen = {name: weight.detach() for name, weight in self.discriminator.named_parameters()}
            of_real, of_generated = self._judged(real, frozen), self._judged(self.decoder(latents), frozen)
            loss = relativistic_loss(of_generated, of_real)
        return {"loss": loss, "of_real": of_real.detach().mean(), "of_generated": of_generated.detach().mean()}

    def _judged(self, images: Float[Tensor, "B 2 H W"], weights: dict[str, Tensor]) -> Float[Tensor, "B"]:
        return functional_call(self.discriminator, weights, (images,))[:, 0]

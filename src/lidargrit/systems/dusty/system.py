"""DUSty: a GAN that generates a clean scan, then drops rays from it; seeds → range images."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor
from torch.func import functional_call

from lidargrit.core.configuration import Settings
from lidargrit.core.determinism import scan_seed
from lidargrit.core.errors import CheckpointError, ConfigError
from lidargrit.core.typed_values import Bounds, Count, NotNegative, Weight
from lidargrit.core.untrusted import SEARCH_STEPS_AT_MOST
from lidargrit.generation.facts import Cost, SamplingSettings, SystemFacts
from lidargrit.generation.generator import Generator
from lidargrit.generation.objective import Objective
from lidargrit.nn.flops import flops_of
from lidargrit.nn.latent_search import search_latents
from lidargrit.nn.published import read_checkpoint
from lidargrit.nn.random import normal_latents, rngs_of
from lidargrit.scans.condition import Condition, Observed
from lidargrit.scans.example import Example
from lidargrit.scans.projection import RangeEncoding
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import MaskDecoding, RangeImage
from lidargrit.systems.dusty.dcgan import LEVELS, Discriminator, Synthesis, Widths, from_published
from lidargrit.systems.dusty.differentiable_augmentation import DifferentiableAugmentation, augment_differentiably


def logistic_noise(size: tuple[int, ...], rng: torch.Generator) -> Float[Tensor, "..."]:
    """Sample logistic noise: logit + noise is above 0 with the logit's probability."""
    uniform = torch.rand(size, generator=rng, device=rng.device).clamp(min=torch.finfo(torch.float32).tiny)
    return uniform.log() - (-uniform).log1p()


def straight_through(logits: Tensor, noise: Tensor) -> Float[Tensor, "..."]:
    """Return 0 or 1 by the sign of logits + noise, with the gradient of a sigmoid.

    Args:
        noise: noise of the same shape, or of one that broadcasts; see :func:`logistic_noise`.

    Source:
        Maddison et al., The Concrete Distribution, 2017; Jang et al., Gumbel-Softmax, 2017, section 2.2.
    """
    soft = torch.sigmoid(logits.float() + noise)
    return ((soft > 0.5).float() - soft).detach() + soft


DustyVariant = Literal["dusty_1", "dusty_2", "baseline"]

_LOGITS: dict[DustyVariant, int] = {"dusty_1": 1, "dusty_2": 2, "baseline": 0}  # maps of returns of the network
_TOLERANCE: dict[DustyVariant, float] = {"dusty_1": 0.0, "dusty_2": 0.0, "baseline": 0.008}  # of the program
_NO_RETURN = -1.0  # as an encoded range; the same as a return at the far limit

_PUBLISHED_BYTES_AT_MOST = 2**29  # weights, their average and the optimiser of a published model take 350 MB


@dataclass(frozen=True)
class DustyConfig(Settings):
    """Networks and losses of DUSty v1; the defaults are the published ones but for two that are named.

    Args:
        variant: form of the published model. ``dusty_1`` drops every ray by a probability of its own; ``dusty_2`` also
            keeps or drops the scan as a whole; ``baseline`` generates a range image with its holes, and far pixels are
            read as no return.
        channels: channels of the finest level of both networks; each of the four coarser levels has twice as many.
        max_channels: largest number of channels of any level.
        penalty_weight: gamma of the penalty on the discriminator's gradient at real images (R1).
        penalty_every: steps between two penalties, each of which then counts as many times (Karras et al., StyleGAN2,
            2020). The program takes it at every step, which is a fifth more computation.
        augmentations: changes of all images that the discriminator sees; see
            lidargrit.systems.dusty.differentiable_augmentation.
    """

    variant: DustyVariant = "dusty_1"
    latent_dim: Count = 512
    channels: Count = 64
    max_channels: Count = 512
    penalty_weight: Weight = 1.0
    penalty_every: Count = 16
    augmentations: tuple[DifferentiableAugmentation, ...] = ("brightness", "contrast", "translation", "cutout")


@dataclass(frozen=True)
class DustySampling(SamplingSettings):
    """Settings of sampling, and of the search for the latent by which a scan is completed.

    Args:
        mask: method by which returns are decided. ``bernoulli`` samples each return with its probability, as the
            program does; ``threshold`` keeps a return that is at least as likely as not.
        raydrop_seed: number that is mixed with a scan's seed for its raydrop only; another number drops other rays of
            the same scan.
        tolerance: smallest distance of a return from the far limit, as a share of the span of inverse range; nearer
            values count as no return. If not given, it is the program's: 0 with a mask, where only the limit itself
            counts as none, and 0.008 for ``baseline``, which was tuned on KITTI odometry and is 58 m there.
        search_steps: number of steps of the optimiser that searches for a latent.
        search_rate: highest learning rate of that optimiser.
    """

    mask: MaskDecoding = "bernoulli"
    raydrop_seed: NotNegative = 0
    tolerance: Weight | None = None
    search_steps: Annotated[int, Bounds(1, SEARCH_STEPS_AT_MOST)] = 1000
    search_rate: Weight = 0.1


class Dusty(Generator[DustyConfig, DustySampling]):
    """A generative adversarial network over inverse range, whose raydrop is a stage of its own.

    Source:
        Nakashima and Kurazume, Learning to Drop Points for LiDAR Scan Synthesis, IROS 2021; its program,
        kazuto1011/dusty-gan@0374a5e, MIT.
    """

    Config = DustyConfig
    trains = (("adversarial", "synthesis"),)
    facts = SystemFacts(
        generates="range and raydrop, sampled over a scan without holes",
        paper="Nakashima and Kurazume, Learning to Drop Points for LiDAR Scan Synthesis, IROS 2021",
        program="kazuto1011/dusty-gan@0374a5e (MIT)",
        weights_licence="MIT, as the program",
    )
    Sampling = DustySampling
    not_of_sampling = frozenset({"search_steps", "search_rate"})
    capabilities = frozenset({"complete"})
    published_files = ("generator",)

    def __init__(self, config: DustyConfig, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        _check_size(sensor)
        self.encoding = InverseRange(sensor)
        self.synthesis = Synthesis(config.latent_dim, _widths(config), _size(sensor), _LOGITS[config.variant])

    @classmethod
    def smallest_config(cls, sensor: SensorModel) -> DustyConfig:
        """Return networks of 4 to 8 channels."""
        return DustyConfig(latent_dim=8, channels=4, max_channels=8)

    @classmethod
    def quickest_sampling(cls) -> DustySampling:
        """Return a search of 4 steps."""
        return DustySampling(search_steps=4)

    @classmethod
    def completion_sampling(cls) -> DustySampling:
        """Return a search of 200 steps, by which a small model came as near to the truth as by the program's 1,000."""
        return DustySampling(search_steps=200)

    def objective(self, stage: str) -> Objective:
        """Return the losses of the network and of a discriminator."""
        return AdversarialObjective(self.synthesis, self.config, self.sensor)

    def _sample(self, seeds: Sequence[int], condition: Condition, sampling: DustySampling) -> RangeImage:
        return self._generate(self._latents(seeds), seeds, sampling)

    def cost(self, sampling: DustySampling | None = None) -> Cost:
        """Return one pass of the network."""
        return Cost(1, flops_of(self.synthesis, (1, self.config.latent_dim)))

    @classmethod
    def read_published(
        cls, files: Sequence[Path], config: DustyConfig, sensor: SensorModel
    ) -> tuple[DustyConfig, dict[str, dict[str, Tensor]]]:
        """Read one checkpoint, whose weights determine the variant and the number of channels.

        Such a file is a dictionary saved by torch. Only ``G_ema`` is read, the moving average of the generator's
        weights, whose names lidargrit.systems.dusty.dcgan translates.

        Source:
            kazuto1011/dusty-gan@0374a5e (MIT), trainers/dcgan_amp.py and utils/__init__.py.
        """
        weights = from_published(read_checkpoint(files[0], ("G_ema",), _PUBLISHED_BYTES_AT_MOST))
        try:
            logits = weights["return_head.weight"].shape[1] if "return_head.weight" in weights else 0
            read = DustyConfig(
                variant=next(name for name, count in _LOGITS.items() if count == logits),
                latent_dim=weights["project.weight"].shape[0],
                channels=weights["range_head.weight"].shape[0],
                max_channels=weights["project.weight"].shape[1],
                penalty_every=1,
            )
        except (KeyError, IndexError, StopIteration):
            got = f"{files[0]}, whose 'G_ema' is no generator of DUSty v1"
            raise CheckpointError(got, "one that its program saved", "check the path") from None
        return read, {"synthesis": weights}

    def _complete(self, condition: Observed, seeds: Sequence[int], sampling: DustySampling) -> RangeImage:
        """Return the nearest scans that the network generates, by the observed returns alone."""
        return self._generate(self._search(condition.images, seeds, sampling), seeds, sampling)

    def _generate(self, latents: Tensor, seeds: Sequence[int], sampling: DustySampling) -> RangeImage:
        encoded, logits = self.synthesis(latents)
        range_m = self.encoding.decode(encoded[:, 0])
        tolerance = _TOLERANCE[self.config.variant] if sampling.tolerance is None else sampling.tolerance
        returned = encoded[:, 0] > _NO_RETURN + 2 * tolerance
        if logits is not None:
            returned &= logits[:, 0] + self._logistic(seeds, sampling) > 0
            if logits.shape[1] > 1:
                returned &= logits[:, 1] > 0
        return RangeImage.masked(range_m, returned, self.sensor)

    def _logistic(self, seeds: Sequence[int], sampling: DustySampling) -> Tensor:
        """Return what is added to logits, whose signs then are sampled returns; each seed has its own numbers."""
        if sampling.mask == "threshold":
            return self._latent_like(torch.zeros(()))
        rngs = rngs_of([scan_seed(seed, sampling.raydrop_seed) for seed in seeds])
        return self._latent_like(torch.stack([logistic_noise(_size(self.sensor), rng) for rng in rngs]))

    def _latents(self, seeds: Sequence[int], *count: int) -> Float[Tensor, "B *count D"]:
        return self._latent_like(normal_latents(seeds, *count, self.config.latent_dim))

    def _latent_like(self, tensor: Tensor) -> Tensor:
        return tensor.to(self.synthesis.project.weight)

    @torch.inference_mode(False)  # gradients are needed, also of a caller who computes in it
    def _search(self, images: RangeImage, seeds: Sequence[int], sampling: DustySampling) -> Float[Tensor, "B D"]:
        """Return the latents whose clean ranges are nearest to those of the returns, by mean inverse range error."""
        target, returned = self.encoding.encode(images)[:, 0], images.return_mask.clone()

        def error_of(latents: Tensor) -> Tensor:
            distance = (self.synthesis(latents)[0][:, 0] - target).abs() / 2
            return (distance * returned).sum((1, 2)) / returned.sum((1, 2)).clamp(min=1)

        return search_latents(error_of, self._latents(seeds, sampling.search_steps + 1), sampling.search_rate)


class InverseRange:
    """Ranges as DUSty's networks see them: linear in 1 / range, 1 at the near limit, -1 at the far one or no return."""

    def __init__(self, sensor: SensorModel) -> None:
        self._nearest_first = RangeEncoding("inverse", sensor.range_min_m, sensor.range_max_m)

    def encode(self, images: RangeImage) -> Float[Tensor, "B 1 H W"]:
        """Encode a batch."""
        everywhere = torch.ones_like(images.return_mask)
        encoded = -self._nearest_first.encode(images.range_m, everywhere)
        return torch.where(images.return_mask, encoded, _NO_RETURN)[:, None]

    def decode(self, encoded: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
        """Return metres."""
        return self._nearest_first.decode(-encoded)


class AdversarialObjective(Objective):
    """DUSty's adversarial losses: two players take turns, with the same random numbers.

    The discriminator learns to tell real scans from generated ones. The other player, the generating network, learns to
    make it take its scans for real (the non-saturating loss of Goodfellow et al., 2014). At every ``penalty_every``-th
    step the discriminator's gradient at real scans is penalised (R1, Mescheder et al., 2018). The discriminator sees
    ranges with their missing returns, never the mask.
    """

    players = ("discriminator", "generator")
    turns: Tensor

    def __init__(self, synthesis: Synthesis, config: DustyConfig, sensor: SensorModel) -> None:
        super().__init__(sensor)
        self.config, self.encoding = config, InverseRange(sensor)
        self.period = config.penalty_every if config.penalty_weight > 0 else 1
        self.synthesis, self.discriminator = synthesis, Discriminator(_widths(config), _size(sensor))
        self.register_buffer("turns", torch.zeros((), dtype=torch.int64))  # of the discriminator

    def forward(self, example: Example, rng: torch.Generator, player: str = "") -> dict[str, Tensor]:
        """Return a player's loss; the other one's weights are out of its reach."""
        images = example.images
        if player == "discriminator":
            with torch.no_grad():
                generated, _ = self._generate_encoded(len(images), rng)
            return self._discriminate(self.encoding.encode(images), generated, rng)
        generated, return_rate = self._generate_encoded(len(images), rng)
        frozen = {name: weight.detach() for name, weight in self.discriminator.named_parameters()}
        logits = functional_call(self.discriminator, frozen, (self._augment(generated, rng),))
        real_rate = images.return_mask.float().mean()
        return {"loss": F.softplus(-logits.float()).mean(), "return_rate": return_rate, "real_return_rate": real_rate}

    def _discriminate(self, real: Tensor, generated: Tensor, rng: torch.Generator) -> dict[str, Tensor]:
        seen, config = self._augment(real, rng), self.config
        takes_penalty = False
        if self.training:
            self.turns += 1
            takes_penalty = config.penalty_weight > 0 and int(self.turns) % config.penalty_every == 0
        seen.requires_grad_(takes_penalty)
        of_real = self.discriminator(seen).float()
        of_generated = self.discriminator(self._augment(generated, rng)).float()
        loss = F.softplus(-of_real).mean() + F.softplus(of_generated).mean()
        terms = {"loss": loss, "real_logit": of_real.mean(), "generated_logit": of_generated.mean()}
        if takes_penalty:
            (gradient,) = torch.autograd.grad(of_real.sum(), seen, create_graph=True)
            penalty = gradient.float().square().sum((1, 2, 3)).mean()
            terms["squared_gradient"] = penalty
            terms["loss"] = loss + config.penalty_weight / 2 * config.penalty_every * penalty
        return terms

    def _generate_encoded(self, count: int, rng: torch.Generator) -> tuple[Tensor, Tensor]:
        latents = torch.randn(count, self.config.latent_dim, generator=rng, device=rng.device)
        encoded, logits = self.synthesis(latents)
        if logits is None:
            return encoded, (encoded.detach() > _NO_RETURN + 2 * _TOLERANCE["baseline"]).float().mean()
        noise = logistic_noise((count, 1, *encoded.shape[-2:]), rng)
        returned = straight_through(logits[:, :1], noise)
        if logits.shape[1] > 1:
            whole = logistic_noise((count, 1, 1, 1), rng) if self.training else torch.zeros_like(noise[..., :1, :1])
            returned = returned * straight_through(logits[:, 1:], whole)
        return returned * encoded + (1 - returned) * _NO_RETURN, returned.detach().mean()

    def _augment(self, images: Tensor, rng: torch.Generator) -> Tensor:
        return augment_differentiably(images, self.config.augmentations, rng)


def _widths(config: DustyConfig) -> Widths:
    return Widths(config.channels, config.max_channels)


def _size(sensor: SensorModel) -> tuple[int, int]:
    return sensor.height, sensor.width


def _check_size(sensor: SensorModel) -> None:
    unit = 1 << LEVELS
    if sensor.height % unit or sensor.width % unit or sensor.height < 2 * unit:
        raise ConfigError(
            f"range images of {sensor.height}x{sensor.width}",
            f"rows and columns in multiples of {unit}, and at least {2 * unit} rows",
            "choose another sensor, or data.columns and data.column_stride",
        )

"""LiDARGen: score matching of log range and reflectance at many noise levels; seeds → range images."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from lidargrit.core.configuration import Settings
from lidargrit.core.errors import CheckpointError, ConfigError
from lidargrit.core.typed_values import Bounds, Positive
from lidargrit.generation.facts import Cost, SamplingSettings, SystemFacts
from lidargrit.generation.generator import Generator
from lidargrit.generation.objective import Objective
from lidargrit.generation.reflectance import reflectance_of_returns
from lidargrit.nn.flops import flops_of
from lidargrit.nn.random import SeededNoise
from lidargrit.scans.condition import Condition, Observed
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage
from lidargrit.systems.lidargen.lidargen_checkpoint import read_lidargen_checkpoint
from lidargrit.systems.lidargen.ncsn import SIDE_AT_LEAST, Ncsn
from lidargrit.systems.lidargen.score_matching import (
    langevin,
    noise_left,
    pull_towards,
    score_matching_errors,
    sigma_table,
    step_that_leaves_least,
)

_LEVELS_AT_MOST = 100_000
_STEPS_AT_MOST = 100_000
_PUBLISHED_STEP = 6.2e-6
_NOISE_LEFT_AT_MOST = 1.5  # over the last level's; the published levels and steps leave 1.18
_LOG2_OF_1 = 6.0  # value of log2(1 + range) that is encoded as 1: 63 m; longer ranges are encoded as that
_NOTHING_M = 1e-4  # is added to every range, and is what a missing return is encoded as
_WINDOWS_M = {"frd": (0.5, 63.0), "bev": (3.0, 70.0), "sensor": (0.0, math.inf)}


@dataclass(frozen=True)
class LidarGenConfig(Settings):
    """Channels, network and noise levels of LiDARGen; the defaults are the published ones.

    Args:
        channels: number of channels of the network's finest level.
        reflectance: whether reflectance is learned beside range; set it to false where scans have none.
        sigma_largest: standard deviation of the noise at the first level; images have values in [0, 1].
        sigma_smallest: standard deviation of the noise at the last level.
        levels: number of noise levels, each smaller than the one before by the same factor.
        steps_each: number of Langevin steps at each level, where the sampling settings do not say otherwise.
    """

    channels: Annotated[int, Bounds(2)] = 128  # the norm compares channels
    reflectance: bool = True
    sigma_largest: Positive = 50.0
    sigma_smallest: Positive = 0.01
    levels: int = 232
    steps_each: int = 5

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sigma_smallest >= self.sigma_largest:
            got = f"sigma_largest={self.sigma_largest}, sigma_smallest={self.sigma_smallest}"
            raise ConfigError(got, "two numbers, the first the larger", "50 and 0.01 are published")
        _check_counts(self.levels, self.steps_each)


@dataclass(frozen=True)
class LangevinSampling(SamplingSettings):
    """Settings of Langevin sampling, and of the window of ranges that count as returns.

    The published 232 levels, 5 steps and step size are those that the theory of Song and Ermon (2020) gives for 32x32
    colour images. For two channels of 64x1024 it gives about 1,450 levels and a step of 1.1e-6. Fewer levels and larger
    steps take less time and move further away from it.

    Args:
        levels: number of noise levels; the model's own number if not given, 232 as published.
        steps_each: number of Langevin steps at each level; the model's own number if not given, 5 as published.
        step_lr: size of a step at the last level; at the others it grows with the square of the noise. If not given, it
            is 6.2e-6, as published, where the levels and steps remove the noise by such steps, as the published ones
            do, and else the size that leaves the least noise: with few levels and steps, samples by the published size
            would be noise.
        raydrop: window of ranges in which a pixel is a return; the sensor's own limits hold besides. The program has no
            rule for its samples, but its scores have: ``frd`` is 0.5 to 63 m, as for its Fréchet distance, ``bev`` 3 to
            70 m, as for its scores from above, and ``sensor`` the sensor's limits alone.
        pull: share of the difference from the observed pixels that each step makes up when a scan is completed.
    """

    levels: int | None = None
    steps_each: int | None = None
    step_lr: Annotated[float, Bounds(above=0, below=1)] | None = None
    raydrop: Literal["frd", "bev", "sensor"] = "frd"
    pull: Annotated[float, Bounds(above=0, most=1)] = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_counts(2 if self.levels is None else self.levels, 1 if self.steps_each is None else self.steps_each)


class LidarGen(Generator[LidarGenConfig, LangevinSampling]):
    """Samples images of log range by annealed Langevin dynamics; a missing return is a range that no return has.

    Source:
        Zyrianov, Zhu and Wang, Learning to Generate Realistic LiDAR Point Clouds, ECCV 2022; numbers from
        vzyrianov/lidargen@4c3226c (MIT).
    """

    Config = LidarGenConfig
    training_precision = "fp32"  # 16 bits round away the noise of the last levels
    trains = (("score", "network"),)
    facts = SystemFacts(
        generates="range and reflectance; a range outside a window is no return",
        paper="Zyrianov, Zhu and Wang, Learning to Generate Realistic LiDAR Point Clouds, ECCV 2022",
        program="vzyrianov/lidargen@4c3226c (MIT)",
        weights_licence="MIT, as the program",
    )
    Sampling = LangevinSampling
    not_of_sampling = frozenset({"pull"})
    capabilities = frozenset({"complete"})
    published_files = ("checkpoint",)

    def __init__(self, config: LidarGenConfig, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        for length in (sensor.height, sensor.width):
            if length % 2 or length < SIDE_AT_LEAST:
                raise ConfigError(
                    f"images of {sensor.height}x{sensor.width} for lidargen",
                    f"even numbers of rows and columns, at least {SIDE_AT_LEAST}",
                    "choose other columns, or another sensor",
                )
        self.shape = (1 + config.reflectance, sensor.height, sensor.width)
        self.network = Ncsn(self.shape[0], config.channels)

    @classmethod
    def smallest_config(cls, sensor: SensorModel) -> LidarGenConfig:
        """Return a network of 4 channels and 4 noise levels."""
        return LidarGenConfig(channels=4, levels=4, steps_each=1)

    @classmethod
    def quickest_sampling(cls) -> LangevinSampling:
        """Return one step at each of 2 levels, so small that an untrained network's values stay in the window."""
        return LangevinSampling(levels=2, steps_each=1, step_lr=1e-9)

    def objective(self, stage: str) -> Objective:
        """Return the score matching of the network."""
        return ScoreMatching(self.network, self.sensor, self.config)

    def _sample(self, seeds: Sequence[int], condition: Condition, sampling: LangevinSampling) -> RangeImage:
        noise = SeededNoise(seeds, self.shape, self.device)
        images = langevin(self.network, noise.uniform(), noise, *self._schedule(sampling))
        return self._decoded(images, sampling)

    def _complete(self, condition: Observed, seeds: Sequence[int], sampling: LangevinSampling) -> RangeImage:
        """Generate scans that agree with the observed pixels, as the paper densifies sparse scans."""
        noise = SeededNoise(seeds, self.shape, self.device)
        observed, images = condition.return_observed[:, None], condition.images
        pull = pull_towards(observed, encode(images, self.config), sampling.pull)
        generated = langevin(self.network, noise.uniform(), noise, *self._schedule(sampling), pull)
        return self._decoded(generated, sampling)

    def cost(self, sampling: LangevinSampling | None = None) -> Cost:
        """Return the network's passes: one a step, and one that removes the noise of the last level."""
        levels, steps_each = self._counts(sampling or LangevinSampling())
        passes = len(levels) * steps_each + 1
        return Cost(passes, passes * flops_of(self.network, (1, *self.shape), (1,)))

    @classmethod
    def read_published(
        cls, files: Sequence[Path], config: LidarGenConfig, sensor: SensorModel
    ) -> tuple[LidarGenConfig, dict[str, dict[str, Tensor]]]:
        """Read one checkpoint, which tells its sizes and noise levels."""
        channels, image_channels, sigmas, weights = read_lidargen_checkpoint(files[0])
        if image_channels not in (1, 2):
            got, wanted = f"{files[0]} for images of {image_channels} channels", "range, or range and reflectance"
            raise CheckpointError(got, wanted, "use another")
        largest, smallest = (float(f"{float(sigmas[at]):.6g}") for at in (0, -1))
        sizes = (channels, image_channels > 1, largest, smallest, len(sigmas), config.steps_each)
        return LidarGenConfig(*sizes), {"network": weights}

    def _counts(self, sampling: LangevinSampling) -> tuple[Float[Tensor, "levels"], int]:
        levels = self.config.levels if sampling.levels is None else sampling.levels
        steps_each = self.config.steps_each if sampling.steps_each is None else sampling.steps_each
        return sigma_table(self.config.sigma_largest, self.config.sigma_smallest, levels), steps_each

    def _schedule(self, sampling: LangevinSampling) -> tuple[Float[Tensor, "levels"], int, float]:
        """Return the noise levels, the number of steps at each, and the size of a step at the last."""
        (sigmas, steps_each), step_lr = self._counts(sampling), sampling.step_lr
        if step_lr is None:
            suits = noise_left(sigmas, steps_each, _PUBLISHED_STEP) < _NOISE_LEFT_AT_MOST
            step_lr = _PUBLISHED_STEP if suits else step_that_leaves_least(sigmas, steps_each)
        return sigmas, steps_each, step_lr

    def _decoded(self, images: Float[Tensor, "B C H W"], sampling: LangevinSampling) -> RangeImage:
        values = images.clamp(0, 1)
        range_m = torch.exp2(_LOG2_OF_1 * values[:, 0]) - 1
        near_m, far_m = _WINDOWS_M[sampling.raydrop]
        sensor = self.sensor
        returned = (range_m > max(near_m, sensor.range_min_m)) & (range_m < min(far_m, sensor.range_max_m))
        planes = {"reflectance": values[:, 1]} if self.config.reflectance else {}
        return RangeImage.masked(range_m, returned, sensor, planes)


class ScoreMatching(Objective):
    """The objective: the squared error of the score at a random noise level, weighed by the square of the noise."""

    sigmas: Tensor

    def __init__(self, network: Ncsn, sensor: SensorModel, config: LidarGenConfig) -> None:
        super().__init__(sensor)
        self.network, self.config = network, config
        sigmas = sigma_table(config.sigma_largest, config.sigma_smallest, config.levels)
        self.register_buffer("sigmas", sigmas, persistent=False)

    def check(self, images: RangeImage) -> None:
        """Refuse images without the reflectance that is to be learned."""
        encode(images, self.config)

    def forward(self, example: Example, rng: torch.Generator, player: str = "") -> dict[str, Tensor]:
        """Return the error, summed over the values of an image, as ``loss``, and that of one value beside it."""
        images = example.images
        clean = encode(images, self.config)
        level = torch.randint(len(self.sigmas), (len(clean),), generator=rng, device=clean.device)
        noise = torch.randn(clean.shape, generator=rng, device=clean.device)
        loss = score_matching_errors(self.network, clean, self.sigmas[level], noise).mean()
        return {"loss": loss, "noise_mse": 2 * loss / clean[0].numel()}


def encode(images: RangeImage, config: LidarGenConfig) -> Float[Tensor, "B C H W"]:
    """Map a batch to the network's input: log2(1 + range) over 6 and reflectance, both in [0, 1].

    A missing return is 2.4e-5, and its reflectance 0.
    """
    level = (torch.log2(images.range_m + _NOTHING_M + 1) / _LOG2_OF_1).clamp(0, 1)
    if not config.reflectance:
        return level[:, None]
    reflectance = reflectance_of_returns(images)
    return torch.stack((level, reflectance.clamp(0, 1) * images.return_mask), dim=1)


def _check_counts(levels: int, steps_each: int) -> None:
    if not 2 <= levels <= _LEVELS_AT_MOST:
        raise ConfigError(f"levels={levels}", f"2 to {_LEVELS_AT_MOST:,}", "232 are published")
    if not 1 <= steps_each <= _STEPS_AT_MOST:
        raise ConfigError(f"steps_each={steps_each}", f"1 to {_STEPS_AT_MOST:,}", "5 are published")

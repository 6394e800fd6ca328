"""R2Flow's trainings: a flow from noise to images, then pairs of noise and scan that straighten it."""

import copy
import math
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from lidargrit.core.configuration import Settings
from lidargrit.core.determinism import scan_seed
from lidargrit.core.errors import ConfigError
from lidargrit.core.typed_values import Bounds, Count
from lidargrit.core.untrusted import STEPS_AT_MOST
from lidargrit.generation.encoding_cache import Frozen
from lidargrit.generation.facts import SamplingSettings
from lidargrit.generation.objective import Objective
from lidargrit.generation.range_values import decode, encode
from lidargrit.nn.flops import flops_of
from lidargrit.nn.precision import in_full
from lidargrit.nn.random import SeededNoise
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage
from lidargrit.systems.r2flow import flow
from lidargrit.systems.r2flow.hdit import Hdit

_STEPS = 256  # of Euler, as published for the first training
_KEPT_BYTES_AT_MOST = 1 << 30  # of pairs in memory: 16,000 scans of 64x256
_HELD_OUT_PAIRS = 64  # for validation
_PAIRS_SEED = 6  # so that no pair begins at the noise of a scan that is sampled
_HUBER_SCALE = 0.00054  # times the root of the number of an image's values, as published


@dataclass(frozen=True)
class FlowSampling(SamplingSettings):
    """Settings of following the flow from noise to a scan.

    Args:
        solver: ``euler`` takes equal steps (published for sampling); ``dopri5`` chooses its own by ``tolerance``, and
            evaluates the network as often as a scan needs it (published for the pairs of the second training).
        steps: number of steps of ``euler``, with one evaluation of the network each. 0 for 256, as published, or for a
            distilled model the number that it was distilled to.
        tolerance: largest error of a step of ``dopri5``, absolute and relative; 1e-5 is published.
    """

    solver: Literal["euler", "dopri5"] = "euler"
    steps: Annotated[int, Bounds(0, STEPS_AT_MOST)] = 0
    tolerance: Annotated[float, Bounds(1e-7, 1)] = 1e-5  # below, 32 bits of the network are the larger error

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.solver == "euler" and self.tolerance != FlowSampling.tolerance:
            got = f"tolerance={self.tolerance:g} for solver=euler, which takes equal steps"
            raise ConfigError(got, "settings that have an effect", "leave it out, or add solver=dopri5")
        for name in ("steps", "batch_size"):
            if self.solver == "dopri5" and (number := getattr(self, name)):
                got = f"{name}={number} for solver=dopri5, which takes steps of its own for each scan"
                raise ConfigError(got, "settings that have an effect", "leave it out, or add solver=euler")


@dataclass(frozen=True)
class ReflowConfig(Settings):
    """The second training, and perhaps a third, on pairs of noise and the scan to which the flow so far leads from it.

    The second (2-RF) straightens the flow, the third (k-TD) distils it to a few equal steps of time.

    Args:
        pairs: number of pairs that the second training learns from.
        distilled_steps: number of steps that the third training distils the flow to; 1, 2 and 4 are published. 0 for no
            third training.
        distilled_pairs: number of pairs that the third training learns from.
        pair_steps: number of equal steps in which the flow so far is followed to make a pair; 0 for the adaptive
            solver, as published.
    """

    pairs: Count = 1_000_000
    distilled_steps: Annotated[int, Bounds(0, _STEPS)] = 0
    distilled_pairs: Count = 100_000
    pair_steps: Annotated[int, Bounds(0, STEPS_AT_MOST)] = 0


def steps_of(sampling: FlowSampling, distilled_steps: int = 0) -> int:
    """Return the number of equal steps that a flow is followed in.

    Args:
        distilled_steps: number of steps that the network was distilled to; 0 if it was not.
    """
    steps = sampling.steps or distilled_steps or _STEPS
    if distilled_steps and (sampling.solver != "euler" or distilled_steps % steps):
        got = f"steps={steps}" if sampling.solver == "euler" else f"solver={sampling.solver}"
        raise ConfigError(
            f"{got} for a model that was distilled to {distilled_steps} equal steps",
            f"solver=euler with a number of steps that divides {distilled_steps}",
            "leave both out",
        )
    return steps


def solve(
    network: Hdit, noise: Float[Tensor, "B C H W"], sampling: FlowSampling, distilled_steps: int = 0
) -> flow.Solved:
    """Follow the flow of a network from noise to images; see :func:`steps_of`."""
    steps = steps_of(sampling, distilled_steps)
    if sampling.solver == "euler":
        return flow.euler(network, noise, steps)
    return flow.dopri5(network, noise, sampling.tolerance)


class FlowMatching(Objective):
    """The first training (1-RF): the squared error of the velocity at a random time between noise and image."""

    ray_buffers = ("network.coords",)

    def __init__(self, network: Hdit, sensor: SensorModel) -> None:
        super().__init__(sensor)
        self.network = network

    def check(self, images: RangeImage) -> None:
        """Refuse images without the reflectance that is to be learned."""
        encode(images, with_reflectance=self.network.images > 1)

    def forward(self, example: Example, rng: torch.Generator, player: str = "") -> dict[str, Tensor]:
        """Return the mean squared error as ``loss``."""
        images = example.images
        clean = encode(images, with_reflectance=self.network.images > 1)
        time = torch.rand(len(clean), generator=rng, device=clean.device)
        noise = torch.randn(clean.shape, generator=rng, device=clean.device)
        predicted: Float[Tensor, "B C H W"] = self.network(flow.interpolated(noise, clean, time), time).float()
        return {"loss": (predicted - (clean - noise)).square().mean()}


class PairMatching(Objective):
    """The later trainings: the pseudo-Huber error of the velocity between noise and the scan that it leads to.

    Of the training images, only their number is used. Pairs are made by the network as it is when the training begins.

    Args:
        network: network that is trained, from the weights that it has.
        pairs: number of pairs to learn from; 64 further ones are for validation.
        solving: settings by which the flow is followed to make them.
        distilled_steps: number of equal steps at whose beginnings the network learns; 0 for all times, those near noise
            and near clean images more often.
    """

    ray_buffers = ("network.coords",)
    over = ("flow", "reflow")

    def __init__(
        self, network: Hdit, sensor: SensorModel, pairs: int, solving: FlowSampling, distilled_steps: int
    ) -> None:
        super().__init__(sensor)
        self.network, self._count, self._distilled_steps = network, pairs, distilled_steps
        self.settings = ("reflow.distilled_steps", "reflow.distilled_pairs") if distilled_steps else ()
        self._pairs = FlowPairs(network, sensor, solving)

    def forward(self, example: Example, rng: torch.Generator, player: str = "") -> dict[str, Tensor]:
        """Return the pseudo-Huber error as ``loss``, and beside it the squared error."""
        images = example.images
        first, count = (0, self._count) if self.training else (self._count, _HELD_OUT_PAIRS)
        chosen = first + torch.randint(count, (len(images),), generator=rng, device=rng.device)
        noise, clean = self._pairs(chosen)
        uniform = torch.rand(len(chosen), generator=rng, device=rng.device)
        if self._distilled_steps:
            time = (uniform * self._distilled_steps).floor() / self._distilled_steps
        else:
            time = flow.u_shaped(uniform, torch.randperm(2 * len(uniform), generator=rng, device=rng.device))
        predicted: Float[Tensor, "B C H W"] = self.network(flow.interpolated(noise, clean, time), time).float()
        error = predicted - (clean - noise)
        loss = flow.pseudo_huber(error, _HUBER_SCALE * math.sqrt(error[0].numel()))
        return {"loss": loss, "squared_error": error.detach().square().mean()}

    def preparation_flops(self, scans: int) -> int:
        """Return the operations of making the pairs; the adaptive solver counts as 256 equal steps."""
        kept = min(self._count, self._pairs.kept_at_most)
        # Pairs are drawn with repetition. One that is kept is made at its first sight, another at every sight.
        made = kept * (1 - (1 - 1 / self._count) ** scans) + scans * (1 - kept / self._count)
        return round(made) * self._pairs.flops()


class FlowPairs(Frozen[Hdit]):
    """Pairs of noise and the scan that a frozen flow leads to, each made once for all times that training sees it.

    The scan is what a file would keep of it: a value outside the sensor's limits is no return, and becomes the lowest
    one. Each pair is made alone and by its own seed, so that it is the same on every machine and after a resumption.
    Once a bound of memory is reached, further pairs are made anew each time.

    Args:
        network: network whose flow is followed; a copy with its present weights is kept.
        solving: settings by which the flow is followed.
        bytes_at_most: bound of the memory that scans take.
    """

    def __init__(
        self, network: Hdit, sensor: SensorModel, solving: FlowSampling, bytes_at_most: int = _KEPT_BYTES_AT_MOST
    ) -> None:
        super().__init__(copy.deepcopy(network).requires_grad_(False))
        self._sensor, self._solving = sensor, solving
        self._shape = (network.images, sensor.height, sensor.width)
        self.kept_at_most = bytes_at_most // (4 * math.prod(self._shape))
        """Number of pairs that the bound of memory holds."""
        self._kept: dict[int, Tensor] = {}

    def __call__(self, numbers: Tensor) -> tuple[Float[Tensor, "B C H W"], Float[Tensor, "B C H W"]]:
        """Return noise and clean images of the pairs with these numbers, on the device of the numbers."""
        if numbers.is_meta:  # without values, where operations are only counted
            empty = numbers.new_empty((len(numbers), *self._shape), dtype=torch.float32)
            return empty, empty
        seeds = [scan_seed(_PAIRS_SEED, number) for number in numbers.tolist()]
        noise = SeededNoise(seeds, self._shape, numbers.device)()
        clean = [self._clean(number, noise[[index]]) for index, number in enumerate(numbers.tolist())]
        return noise, torch.cat(clean).to(noise)

    def flops(self) -> int:
        """Return the floating-point operations of making one pair."""
        return steps_of(self._solving) * flops_of(self._network, (1, *self._shape), (1,))

    @torch.no_grad()
    def _clean(self, number: int, noise: Float[Tensor, "1 C H W"]) -> Float[Tensor, "1 C H W"]:
        end = self._kept.get(number)
        if end is None:
            with in_full(noise.device):
                end = solve(self.network(noise.device), noise, self._solving).images
            end = as_kept(end, self._sensor).cpu()
            if len(self._kept) < self.kept_at_most:
                self._kept[number] = end
        return end


def as_kept(values: Float[Tensor, "B C H W"], sensor: SensorModel) -> Float[Tensor, "B C H W"]:
    """Return generated images as if they had been saved as ranges in metres and read again.

    Source:
        kazuto1011/r2flow@3f5afeb (MIT), whose pairs are files of metres, with the reflectance of all pixels.
    """
    levels = encode(decode(values[:, :1], sensor), with_reflectance=False)
    return torch.cat((levels, values[:, 1:].clamp(-1, 1)), dim=1)

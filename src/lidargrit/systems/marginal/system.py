"""Pixel statistics: every pixel sampled from its own histogram, as if it had no neighbours; seeds → range images."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from lidargrit.core.configuration import Settings
from lidargrit.core.errors import CheckpointError
from lidargrit.core.typed_values import Bounds
from lidargrit.generation.batches import BatchSeeds
from lidargrit.generation.facts import Cost, SamplingSettings, SystemFacts
from lidargrit.generation.generator import Generator
from lidargrit.nn.random import rngs_of
from lidargrit.scans.condition import Condition
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage

_BATCH = 16


@dataclass(frozen=True)
class MarginalConfig(Settings):
    """Resolution of the histograms of range.

    Args:
        bins: number of bins of a logarithmic axis between the sensor's limits; with 128, each is 4 % wide.
    """

    bins: Annotated[int, Bounds(1, 4096)] = 128


@runtime_checkable
class ImageBatches(Protocol):
    """Range images that are read in batches, such as those of a data set or the compared ones of an evaluation."""

    def __len__(self) -> int: ...

    def batch(self, indices: Sequence[int], /) -> RangeImage:
        """Return some of the images."""
        ...


class Marginal(Generator[MarginalConfig, SamplingSettings]):
    """Samples every pixel from its own histogram of range and return, independently of all others.

    A metric that gives it a good score does not look at shapes. It has no stage to train by an objective: it counts,
    see :meth:`fit_statistics`.
    """

    Config = MarginalConfig
    own_batches = (_BATCH, _BATCH)  # the histograms are summed up once for all of them
    facts = SystemFacts(generates="range and raydrop, every pixel by itself")
    scans: Tensor
    counts: Tensor

    def __init__(self, config: MarginalConfig, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        self.register_buffer("scans", torch.zeros((), dtype=torch.int64))
        self.register_buffer("counts", torch.zeros(config.bins, sensor.height, sensor.width, dtype=torch.int32))

    @classmethod
    def smallest_config(cls, sensor: SensorModel) -> MarginalConfig:
        """Return a histogram of 16 bins."""
        return MarginalConfig(bins=16)

    def fit_statistics(self, images: ImageBatches) -> None:
        """Count the returns of all images."""
        edges = self._edges_m()[1:-1]
        self.counts.zero_()
        self.scans.zero_()
        for first in range(0, len(images), _BATCH):
            batch = images.batch(range(first, min(first + _BATCH, len(images))))
            bins = torch.bucketize(batch.range_m, edges)
            for one, mask in zip(bins, batch.return_mask, strict=True):
                self.counts.scatter_add_(0, one[None], mask[None].int())
            self.scans += len(batch)

    @classmethod
    def from_weights(
        cls, config: MarginalConfig, sensor: SensorModel, weights: dict[str, Tensor], source: Path
    ) -> "Marginal":
        """Make a generator of given counts."""
        generator = super().from_weights(config, sensor, weights, source)
        counts, scans = generator.counts, generator.scans
        if bool((counts < 0).any()) or bool((counts.sum(dim=0) > scans).any()):
            got = f"{source}, with pixels of less than 0 returns, or of more than its {int(scans)} scans"
            raise CheckpointError(got, "0 to as many as there are scans", "restore the file, or train again")
        return generator

    def _sample(self, seeds: BatchSeeds, condition: Condition, sampling: SamplingSettings) -> RangeImage:
        if not int(self.scans):
            raise CheckpointError("a generator that has counted no scan", "one that has", "call fit_statistics first")
        edges = self._edges_m().to(self.counts.device)
        total = self.counts.cumsum(dim=0)
        images = []
        for rng in rngs_of(seeds[: seeds.num_asked_for]):
            uniform = torch.rand(3, self.sensor.height, self.sensor.width, generator=rng).to(self.counts.device)
            returned = uniform[0] < total[-1] / self.scans
            # The first bin at which the counts so far exceed the sampled share of all.
            chosen = (total <= uniform[1] * total[-1]).sum(dim=0).clamp(max=self.config.bins - 1)
            low, high = edges[chosen], edges[chosen + 1]
            images.append(RangeImage.masked(low * (high / low) ** uniform[2], returned, self.sensor))
        return RangeImage.stack(images)

    def cost(self, sampling: SamplingSettings | None = None) -> Cost:
        """Return nothing: there is no network."""
        return Cost(0, 0)

    def _edges_m(self) -> Float[Tensor, " edges"]:
        low, high = torch.tensor([self.sensor.range_min_m, self.sensor.range_max_m], dtype=torch.float64).log()
        edges = torch.linspace(float(low), float(high), self.config.bins + 1, dtype=torch.float64).exp().float()
        edges[0], edges[-1] = self.sensor.range_min_m, self.sensor.range_max_m  # not a rounding error beyond
        return edges

"""Memorised training scans, as a reference row: seeds → range images."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from lidargrit.core.configuration import Settings
from lidargrit.core.determinism import evenly_spaced
from lidargrit.core.errors import CheckpointError
from lidargrit.core.typed_values import Bounds
from lidargrit.data.images import RangeImages
from lidargrit.generation.facts import Cost, SamplingSettings, SystemFacts
from lidargrit.generation.generator import Generator
from lidargrit.nn.exact_weights import load_exactly
from lidargrit.scans.condition import Condition
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage


@dataclass(frozen=True)
class MemorisedConfig(Settings):
    """Number of training scans that are kept.

    Args:
        scans: largest number of training scans that are kept, evenly spaced; 64x1024 pixels take 0.26 MB each.
    """

    scans: Annotated[int, Bounds(1, 100_000)] = 1000


class Memorised(Generator[MemorisedConfig, SamplingSettings]):
    """Returns the ranges of training scans: the best score of a generator that learns nothing.

    A generator that scores better on held-out scans has learned something; one that scores the same may have learned
    them by heart. It has no stage to train by an objective: it keeps scans, see :meth:`fit_statistics`.
    """

    Config = MemorisedConfig
    facts = SystemFacts(generates="ranges of training scans, unchanged; no reflectance")
    scans: Tensor
    range_m: Tensor

    def __init__(self, config: MemorisedConfig, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        self.register_buffer("scans", torch.zeros((), dtype=torch.int64))
        self.register_buffer("range_m", torch.zeros(0, sensor.height, sensor.width))

    @classmethod
    def smallest_config(cls, sensor: SensorModel) -> MemorisedConfig:
        """Return room for 8 scans."""
        return MemorisedConfig(scans=8)

    def fit_statistics(self, images: RangeImages) -> None:
        """Keep the images, in an order that does not follow the drive, so that the first seeds are not neighbours."""
        kept = evenly_spaced(self.config.scans, len(images))
        self.range_m = torch.zeros(len(kept), self.sensor.height, self.sensor.width)
        for slot, index in enumerate(torch.randperm(len(kept), generator=torch.Generator().manual_seed(0)).tolist()):
            self.range_m[slot] = images.batch([kept[index]]).range_m[0]
        self.scans.fill_(len(kept))

    @classmethod
    def from_weights(
        cls, config: MemorisedConfig, sensor: SensorModel, weights: dict[str, Tensor], source: Path
    ) -> "Memorised":
        """Make a generator that keeps as many scans as the weights hold."""
        generator, kept = cls(config, sensor), weights.get("range_m", torch.zeros(0))
        if kept.ndim == 3:
            generator.range_m = torch.zeros(len(kept), sensor.height, sensor.width)
        load_exactly(generator, weights, source)
        if int(generator.scans) != len(generator.range_m):
            got = f"{source}, which counts {int(generator.scans)} scans and holds {len(generator.range_m)}"
            raise CheckpointError(got, "as many as it counts", "restore the file, or train again")
        return generator.eval()

    def _sample(self, seeds: Sequence[int], condition: Condition, sampling: SamplingSettings) -> RangeImage:
        """Return the scan of each seed: as many seeds in a row as there are scans give each of them once."""
        if not int(self.scans):
            raise CheckpointError("a generator that has kept no scan", "one that has", "call fit_statistics first")
        range_m = self.range_m[torch.tensor([seed % int(self.scans) for seed in seeds])]
        return RangeImage(range_m, range_m > 0, self.sensor)

    def cost(self, sampling: SamplingSettings | None = None) -> Cost:
        """Return nothing: there is no network."""
        return Cost(0, 0)

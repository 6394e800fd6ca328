"""A segmenter: scans → the class of every return, by SemanticKITTI's numbers."""

from dataclasses import dataclass, field

import torch

from lidargrit.core.configuration import Settings
from lidargrit.generation.batches import check_images, one_by_one
from lidargrit.generation.facts import Cost, NoSampling, SystemFacts
from lidargrit.generation.generator import Generator
from lidargrit.generation.objective import Objective
from lidargrit.nn.flops import FlopCounter
from lidargrit.scans.condition import Condition
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage
from lidargrit.systems.segmenter.network import SegmenterNetwork, SegmenterNetworkConfig
from lidargrit.systems.segmenter.objective import SegmenterObjective


@dataclass(frozen=True)
class SegmenterConfig(Settings):
    """The network, which is the whole system.

    Args:
        segmenter: sizes of the segmenter's network, and what it sees.
    """

    segmenter: SegmenterNetworkConfig = field(default_factory=SegmenterNetworkConfig)


class Segmenter(Generator[SegmenterConfig, NoSampling]):
    """A network that tells of every return which of the 19 classes of SemanticKITTI's benchmark it is."""

    Config = SegmenterConfig
    trains = (("segmenter", "segmenter"),)
    facts = SystemFacts(
        generates="a label for every return of a scan; no scans",
        first_command="segment SCANS labelled --model RUN",
    )
    is_random = False

    def __init__(self, config: SegmenterConfig, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        self.segmenter = SegmenterNetwork(config.segmenter, sensor)

    @classmethod
    def smallest_config(cls, sensor: SensorModel) -> SegmenterConfig:
        """Return a network of eight channels and one block."""
        return SegmenterConfig(SegmenterNetworkConfig((8, 8, 8), blocks=1, attention_layers=0, heads=1))

    @property
    def takes(self) -> frozenset[type[Condition]]:
        """No condition at all: it has no scans to sample."""
        return frozenset()

    def objective(self, stage: str) -> Objective:
        """Return the errors of the classes."""
        return SegmenterObjective(self.segmenter, self.sensor)

    @torch.no_grad()
    def segment(self, images: RangeImage) -> RangeImage:
        """Return scans with the likeliest class of each return as its label, each scan computed by itself.

        Args:
            images: batch of range images (B, H, W); labels that they have are not read.
        """
        check_images(images, self.sensor)
        self.eval()
        found = [self.segmenter.classes(image) for image in one_by_one(images.to(self.device))]
        return images.with_planes(label=torch.cat(found).to(images.range_m.device))

    def cost(self, sampling: NoSampling | None = None) -> Cost:
        """Return the cost of labelling one scan, counted while it is computed."""
        with torch.no_grad(), FlopCounter() as counter:
            self.segmenter(torch.zeros(1, self.sensor.height, self.sensor.width, device=self.device))
        return Cost(1, counter.total)

"""R2Flow: a rectified flow of log range and reflectance, raydrop by a window of ranges; seeds → range images."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from lidargrit.core.configuration import Settings
from lidargrit.generation.facts import Cost, SystemFacts
from lidargrit.generation.generator import Generator
from lidargrit.generation.objective import Objective
from lidargrit.generation.range_values import decode
from lidargrit.nn.flops import flops_of
from lidargrit.nn.random import SeededNoise
from lidargrit.scans.condition import Condition
from lidargrit.scans.sensors import SensorModel, continuous_azimuths_rad
from lidargrit.scans.types import RangeImage
from lidargrit.systems.r2flow import flow
from lidargrit.systems.r2flow.hdit import Hdit, HditConfig
from lidargrit.systems.r2flow.r2flow_checkpoint import read_r2flow_checkpoint
from lidargrit.systems.r2flow.rectified_flow import (
    FlowMatching,
    FlowSampling,
    PairMatching,
    ReflowConfig,
    solve,
    steps_of,
)

_COST_SEED = 0


@dataclass(frozen=True)
class R2flowConfig(Settings):
    """Channels, network and trainings of R2Flow.

    Args:
        reflectance: whether to learn the reflectance beside the range, as published; false where scans have none.
        reflow: settings of the trainings after the first, which straighten the flow; None for the first alone (1-RF).
    """

    hdit: HditConfig = field(default_factory=HditConfig)
    reflectance: bool = True
    reflow: ReflowConfig | None = None


class R2flow(Generator[R2flowConfig, FlowSampling]):
    """Generates the image of log ranges, in which a missing return is a range that no return has.

    It is trained in up to three stages: ``flow`` from noise to scans (1-RF), ``reflow`` on pairs of noise and the scan
    that it leads to (2-RF), and ``distillation`` to few equal steps (k-TD).

    Source:
        Nakashima et al., Fast LiDAR Data Generation with Rectified Flows, ICRA 2025; numbers from
        kazuto1011/r2flow@3f5afeb (MIT).
    """

    Config = R2flowConfig
    trains = (("flow", "network"), ("reflow", "network"), ("distillation", "network"))
    facts = SystemFacts(
        generates="range and reflectance; a range outside the sensor's limits is no return",
        paper="Nakashima et al., Fast LiDAR Data Generation with Rectified Flows, ICRA 2025",
        program="kazuto1011/r2flow@3f5afeb (MIT)",
        weights_licence="MIT, as the program",
    )
    Sampling = FlowSampling
    published_files = ("network",)

    def __init__(self, config: R2flowConfig, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        self.shape = (1 + config.reflectance, sensor.height, sensor.width)
        angles = torch.broadcast_tensors(sensor.elevation_rad, continuous_azimuths_rad(sensor.azimuth_rad).float())
        self.network = Hdit(config.hdit, self.shape[0], *(angle.contiguous() for angle in angles))

    @classmethod
    def smallest_config(cls, sensor: SensorModel) -> R2flowConfig:
        """Return a transformer of two levels and 8 channels, and every training with 4 pairs."""
        reflow = ReflowConfig(pairs=4, distilled_steps=2, distilled_pairs=4, pair_steps=2)
        return R2flowConfig(HditConfig(8, 8, (1, 1), (1, 2)), reflow=reflow)

    @classmethod
    def quickest_sampling(cls) -> FlowSampling:
        """Return two steps of Euler."""
        return FlowSampling(steps=2)

    def batch_size(self, sampling: FlowSampling | None = None) -> int:
        """Return 1 for a solver whose steps would depend on the other scans of a batch."""
        return 1 if sampling is not None and sampling.solver == "dopri5" else super().batch_size(sampling)

    @property
    def stages(self) -> tuple[str, ...]:
        """The flow, its straightening, its distillation to few steps; the latter two if so configured."""
        if self.config.reflow is None:
            return ("flow",)
        return ("flow", "reflow", "distillation") if self.config.reflow.distilled_steps else ("flow", "reflow")

    def objective(self, stage: str) -> Objective:
        """Return the matching of velocities between noise and scans, or between pairs that the flow so far gives."""
        reflow = self.config.reflow
        if stage == "flow" or reflow is None:
            return FlowMatching(self.network, self.sensor)
        pairs, steps = (reflow.pairs, 0) if stage == "reflow" else (reflow.distilled_pairs, reflow.distilled_steps)
        solving = FlowSampling(steps=reflow.pair_steps) if reflow.pair_steps else FlowSampling(solver="dopri5")
        return PairMatching(self.network, self.sensor, pairs, solving, steps)

    def _sample(self, seeds: Sequence[int], condition: Condition, sampling: FlowSampling) -> RangeImage:
        return decode(self._solved(seeds, sampling).images, self.sensor)

    @torch.no_grad()
    def cost(self, sampling: FlowSampling | None = None) -> Cost:
        """Return the network's passes.

        With ``dopri5`` their number differs from scan to scan: those of the seed 0 are returned, which takes as long as
        sampling it.
        """
        sampling = sampling or FlowSampling()
        passes = steps_of(sampling, self._distilled_steps)
        if sampling.solver == "dopri5":
            passes = self.eval()._solved([_COST_SEED], sampling).evaluations
        return Cost(passes, passes * flops_of(self.network, (1, *self.shape), (1,)))

    @classmethod
    def read_published(
        cls, files: Sequence[Path], config: R2flowConfig, sensor: SensorModel
    ) -> tuple[R2flowConfig, dict[str, dict[str, Tensor]]]:
        """Read one checkpoint, which tells the sizes of its network, and if its flow was distilled."""
        hdit, channels, steps, weights = read_r2flow_checkpoint(files[0], sensor)
        reflow = ReflowConfig(distilled_steps=steps) if steps else None
        return R2flowConfig(hdit, channels > 1, reflow), {"network": weights}

    def _solved(self, seeds: Sequence[int], sampling: FlowSampling) -> flow.Solved:
        noise = SeededNoise(seeds, self.shape, self.device)()
        return solve(self.network, noise, sampling, self._distilled_steps)

    @property
    def _distilled_steps(self) -> int:
        return 0 if self.config.reflow is None else self.config.reflow.distilled_steps

"""The plan of a preset's training: every setting by its name, sizes, budgets and estimated cost."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch

from lidargrit.core import configuration, reporting
from lidargrit.core.errors import ConfigError
from lidargrit.data.images import RangeImages
from lidargrit.data.sources import DatasetSource, PreparedSource, open_to_train
from lidargrit.generation import conditions
from lidargrit.generation.conditions import ToldOfScans
from lidargrit.generation.objective import Objective
from lidargrit.generation.settings import Preset
from lidargrit.nn.precision import Precision
from lidargrit.scans.condition import Nothing
from lidargrit.training.compute import computing_time, training_flops
from lidargrit.training.optimiser import memory_of_weights
from lidargrit.training.stage import follow_settings
from lidargrit.training.taken_stages import taken_stages


@dataclass(frozen=True)
class StagePlan:
    """Size and cost of the training of one stage.

    Args:
        parameters: number of weights that the stage trains or uses.
        batch_size: number of scans in a step, over all processes.
        memory: size of weights, their average, gradients and the optimiser's moments, in bytes, without activations.
        taken_from: run whose trained stage is used as it is, so that nothing is computed; "" if the stage is trained.
    """

    name: str
    parameters: int
    scans: int
    batch_size: int
    memory: int
    flops: int
    precision: Precision
    taken_from: str = ""


@dataclass(frozen=True)
class TrainingPlan:
    """Settings, sizes and costs of the training of a preset.

    Args:
        published: scores that a paper reports for the preset, or "".
        settings: value of every setting, by its dotted name.
        range_m: nearest and farthest range of a return, in metres.
    """

    title: str
    published: str
    settings: dict[str, Any]
    rows: int
    columns: int
    range_m: tuple[float, float]
    stages: tuple[StagePlan, ...]

    @property
    def flops(self) -> dict[str, int]:
        """Number of floating-point operations of each stage that is trained."""
        return {stage.name: stage.flops for stage in self.stages if not stage.taken_from}

    def as_text(self) -> str:
        """Return all of it as lines for a person."""
        lines = [self.title, f"published: {self.published or 'no score'}", ""]
        lines += [f"  {name} = {value}" for name, value in self.settings.items()]
        near_m, far_m = self.range_m
        lines += ["", f"range images of {self.rows}x{self.columns}, {near_m:g} to {far_m:g} m"]
        trained = [stage for stage in self.stages if not stage.taken_from]
        lines += [
            f"{stage.name}: {stage.parameters:,} parameters, taken from {stage.taken_from} and not trained"
            for stage in self.stages
            if stage.taken_from
        ]
        lines += [
            f"{stage.name}: {stage.parameters:,} parameters, {stage.scans:,} scans in batches of {stage.batch_size}, "
            f"{stage.memory / 2**20:,.0f} MiB of memory besides activations"
            for stage in trained
        ]
        lines += [f"{stage.name}: {computing_time(stage.flops, stage.precision)}" for stage in trained]
        return "\n".join(lines)

    def to_json(self) -> dict[str, Any]:
        """Return all of it as plain values."""
        return asdict(self)


@dataclass(frozen=True)
class OpenedData:
    """Sources of a preset's scans, of which none has been read."""

    train: Sequence[DatasetSource | PreparedSource]
    val: Sequence[DatasetSource | PreparedSource]


def open_data(preset: Preset) -> OpenedData:
    """Open the sources of training and validation scans, as far as they can be checked before a scan is read."""
    opened = OpenedData(open_to_train(preset.data.train, preset.data), open_to_train(preset.data.val, preset.data))
    for source in (*opened.train, *opened.val):
        if isinstance(source, PreparedSource):
            with reporting.to(reporting.Reporter()):  # training says it when it opens them
                source.images(preset.data.load_sensor(), preset.data)
    return opened


@dataclass(frozen=True)
class CheckedStages:
    """Stages of a preset whose training can begin.

    Args:
        objectives: objective of every stage, without values, by the name of the stage.
        taken: trained stages of another run, which are taken as they are or trained further.
        frozen: run from which a stage is taken as it is, by the name of the stage; the others are trained.
        told: source of the condition that the generator is told of each scan.
    """

    objectives: Mapping[str, Objective]
    taken: Mapping[str, Objective]
    frozen: Mapping[str, str]
    told: ToldOfScans

    @property
    def trained(self) -> dict[str, Objective]:
        """The objectives of the stages that are trained, by name."""
        return {name: objective for name, objective in self.objectives.items() if name not in self.frozen}

    def check_images(self, setting: str, images: RangeImages) -> None:
        """Refuse images that lack what a stage learns from, as their first one tells.

        Args:
            setting: setting that names their sources, for the message.
        """
        for name, objective in self.trained.items():
            try:
                objective.check(images.batch([0]))
                self.told.of(images.batch([0]))
            except ConfigError as lacking:
                why = f"{setting}, for the stage {name}: {lacking.got}"
                raise ConfigError(why, lacking.wanted, lacking.cure) from None


def check_stages(preset: Preset, processes: int = 1) -> CheckedStages:
    """Refuse settings of any stage that its training would refuse, and stages to take that do not fit."""
    sensor = preset.data.load_sensor()
    with torch.device("meta"):  # sizes alone, without values, so that wide networks take no time
        generator = preset.build_generator(sensor).to("meta")
        objectives = {name: generator.objective(name) for name in generator.stages}
    if preset.data.own_sensors and not generator.takes_any_sensor:
        got = f"data.own_sensors=true for {generator.public_name()!r}, whose networks know the rays of one sensor"
        raise ConfigError(got, "a model of any sensor, such as multiscale_any", "leave it out")
    taken = taken_stages(preset, generator)
    told = conditions.load(preset.data.condition, generator.past_scans)
    if told.kind is not Nothing and told.kind not in generator.takes:
        got = f"data.condition={preset.data.condition} for {generator.public_name()!r}, which cannot be told it"
        raise ConfigError(got, "a generator that takes it", "leave it out")
    checked = CheckedStages(objectives, taken, preset.frozen, told)
    for name, objective in checked.trained.items():
        follow_settings(objective, preset.settings_of(name), processes)
    return checked


def plan_training(preset: Preset) -> TrainingPlan:
    """Return the plan of a preset's training; no scan is read, and nothing is written.

    Raises:
        ConfigError: settings that a stage cannot follow, or a stage to take from another run that does not fit.
        CheckpointError: no finished run to take stages from.
    """
    sensor = preset.data.load_sensor()
    checked, stages = check_stages(preset), []
    flops = training_flops(preset)
    for name, objective in checked.objectives.items():
        parameters = sum(weight.numel() for weight in objective.parameters())
        budget = preset.settings_of(name)
        if name in checked.frozen:
            stages.append(StagePlan(name, parameters, 0, 0, 0, 0, budget.precision, checked.frozen[name]))
            continue
        size = (parameters, budget.scans, budget.batch_size, memory_of_weights(objective))
        stages.append(StagePlan(name, *size, flops[name], budget.precision))
    return TrainingPlan(
        preset.title,
        preset.published,
        configuration.leaves(preset),
        sensor.height,
        sensor.width,
        (sensor.range_min_m, sensor.range_max_m),
        tuple(stages),
    )

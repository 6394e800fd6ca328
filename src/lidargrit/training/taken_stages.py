"""Trained stages of other runs that a preset starts from: preset → objectives by the name of their stage."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lidargrit.core import configuration
from lidargrit.core.errors import ConfigError
from lidargrit.core.files import read_json
from lidargrit.data.run_folder import (
    CHECKPOINT_FILE,
    RUN_FILE,
    is_run,
    locate,
    named_folder,
    shaped_as_ours,
    taken_over,
)
from lidargrit.generation.generator import Generator, load
from lidargrit.generation.objective import Objective
from lidargrit.generation.settings import Preset
from lidargrit.training.checkpoint import load_average

_UNKNOWN_SCANS = "a run that does not say on which scans it was trained"  # in the place of a source
_NOT_LEARNED = (  # of sampling, of training, and of another stage
    *("range_temperature", "surface_temperature", "mask_temperature", "own_context"),
    *("distilled_steps", "distilled_pairs"),
)


def taken_facts(preset: Preset) -> dict[str, Any]:
    """Return what a run must tell of the weights that it takes: training scans and files of all before it.

    Returns:
        sources of training scans (``train``), files of imported weights (``files``), and the settings by which the
        stages that are not trained here were trained, None where they are not known (``training``).
    """
    train: set[str] = set()
    files, training = [], {}
    for run in sorted({*preset.start_runs.values()}):
        path = locate(run) / RUN_FILE
        about = read_json(path) if path.is_file() else {}
        with shaped_as_ours(path):
            theirs, before = about.get("preset") or {}, taken_over(about)
            trained = {} if about.get("files") else {**theirs.get("training", {}), **before["training"]}
            train |= {*map(str, [*theirs.get("data", {}).get("train", [_UNKNOWN_SCANS]), *before["train"]])}
            files += [*about.get("files", ()), *before["files"]]
            training |= {stage: trained.get(stage) for stage, of in preset.frozen.items() if of == run}
    return {"train": sorted(train), "files": files, "training": training}


def taken_stages(preset: Preset, generator: Generator) -> dict[str, Objective]:
    """Return the trained stages that a preset takes from other runs, once they are known to fit the generator.

    Those that are trained further may lack what :attr:`Objective.additions` add, which begins untrained, and may be of
    another sensor if its weights fit. A run may be of another generator if the stage learns by the same objective.
    """
    runs = {stage: run for stage, run in preset.start_runs.items() if stage in generator.stages}
    loaded, found = {run: load(Path(run)) for run in sorted({*runs.values()})}, {}
    for name, run in runs.items():
        other, config, ours = loaded[run], preset.training[name], _Stage(name, generator)
        setting = f"training.{name}.start={config.start}"
        # Of a tokenizer :func:`_check` tells the kind.
        kinds = (type(ours.objective), *(() if config.frozen else ours.objective.kin))
        alike = name in other.stages and (name == "tokenizer" or type(other.objective(name)) in kinds)
        if not alike:
            in_bundle = is_run(named_folder(run) / name)
            raise ConfigError(
                f"{setting}, a run of the generator {other.public_name()!r}",
                f"a run of {generator.public_name()!r}, or of another with the same stage {name!r}",
                f"set training.{name}.start={run}/{name}" if in_bundle else "choose another run",
            )
        theirs = _Stage(name, other)
        _check(setting, ours, theirs, trained=not config.frozen)
        if config.frozen:
            _check_base(preset, ours)
        else:
            _restore(setting, run, theirs)
        found[name] = theirs.objective
    return found


class _Stage:
    """A stage of a generator: its name, its objective, the settings that it learns by, and what their names begin with.

    Where no setting has the stage's name, its settings are all that have no other stage's.
    """

    def __init__(self, name: str, generator: Generator) -> None:
        self.name, self.objective = name, generator.objective(name)
        self.shapes = _shapes(self.objective.state_dict())
        settings = configuration.leaves(configuration.to_json(generator.config))
        begun = {key: value for key, value in settings.items() if key.startswith(f"{name}.")}
        own = {key: value for key, value in begun.items() if key.rpartition(".")[2] not in _NOT_LEARNED}
        others = {key: value for key, value in settings.items() if key.partition(".")[0] not in generator.stages}
        further = {key: settings[key] for key in self.objective.settings if key in settings}
        kind = {"tokenizer.name": generator.get_tokenizer().config.name()} if name == "tokenizer" else {}
        self.prefix = f"model.{name}" if own and not further else "model"
        self.settings = {**kind, **(own or others), **further}  # the kind comes first: what differs first is told


def _restore(setting: str, run: str, stage: _Stage) -> None:
    """Give an objective what a finished generator does not keep, such as a discriminator, where the run has it."""
    checkpoint = locate(run) / stage.name / CHECKPOINT_FILE
    if checkpoint.is_file():
        load_average(checkpoint, stage.objective)
    elif stage.objective.players:
        raise ConfigError(
            f"{setting} without {checkpoint}, which has the trained discriminator",
            "the folder of the training with its checkpoints",
            f"name that folder, or begin with new weights: training.{stage.name}.start=",
        )


def _check_base(preset: Preset, stage: _Stage) -> None:
    """Refuse a stage taken as it is whose training rested on other networks than those that are taken beside it."""
    start = preset.training[stage.name].start
    for base in (name for name in stage.objective.over if name != stage.name and name in preset.training):
        if preset.training[base].start != start:
            raise ConfigError(
                f"training.{stage.name}.start={start} without training.{base}.start={start}",
                f"both frozen, or neither: the {stage.name} learned from that {base} and is of no use with another",
                f"set training.{base}.start, or train the {stage.name}",
            )


def _check(setting: str, mine: _Stage, given: _Stage, trained: bool) -> None:
    """Refuse a stage whose sizes or sensor are not the generator's.

    Dropout, which belongs to the training before, and settings that sampling alone reads may differ. A stage that is
    trained further may lack its additions, and may be of another sensor if its weights fit this one.
    """
    stage, ours, theirs = mine.name, mine.settings, given.settings
    differing = [name for name in ours if ours[name] != theirs.get(name) and not name.endswith("dropout")]
    if type(given.objective) in mine.objective.kin:  # the shapes tell
        differing = []
    same_sensor = mine.objective.sensor.same_rays(given.objective.sensor)
    given_shapes = given.shapes
    if trained:
        additions = [f"{stage}.{name}" for name in mine.objective.additions]
        added = {name for name in additions if ours.get(name) and not theirs.get(name)}
        differing = [name for name in differing if name not in added]
        given_shapes = _shapes(mine.objective.weights_from(given.objective))
        same_sensor |= mine.shapes.items() >= given_shapes.items()
    others = [f"model.{name}={theirs.get(name)}" for name in differing]
    if same_sensor:  # sizes that settings of other stages decide, such as the number of codes
        others += [
            f"{name} of {'x'.join(map(str, shape))}"
            for name, shape in given_shapes.items()
            if mine.shapes.get(name, shape) != shape
        ]
    if others or not same_sensor:
        raise ConfigError(
            f"{setting}, whose {stage} is another ({[*others, 'data.sensor'][0]})",
            f"one of this preset's {mine.prefix} and sensor",
            "set them as there, or choose another run",
        )


def _shapes(weights: Mapping[str, Tensor]) -> dict[str, torch.Size]:
    return {name: weight.shape for name, weight in weights.items()}

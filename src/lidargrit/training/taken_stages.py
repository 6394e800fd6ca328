"""Trained stages of another run that a preset takes as they are: preset → objectives by the name of their stage."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lidargrit.core import configuration
from lidargrit.core.errors import ConfigError
from lidargrit.core.files import read_json
from lidargrit.data.run_folder import CHECKPOINT_FILE, RUN_FILE, locate, taken_over
from lidargrit.generation.generator import Generator, load
from lidargrit.generation.objective import Objective
from lidargrit.generation.settings import Preset
from lidargrit.training.checkpoint import load_average

_UNKNOWN_SCANS = "a run that does not say on which scans it was trained"  # in the place of a source
_NOT_LEARNED = ("range_temperature", "distilled_steps", "distilled_pairs")  # of sampling, and of another stage


def donors_of_stages(preset: Preset, taken: Iterable[str]) -> dict[str, str]:
    """Return the run of each stage that is taken as it is and not trained further, by the name of the stage.

    Args:
        taken: names of :func:`taken_stages`.
    """
    run = preset.tokenizer_from or preset.stages_from or ""
    return {stage: run for stage in taken if stage not in preset.fine_tune}


def taken_facts(preset: Preset, donors: Mapping[str, str]) -> dict[str, Any]:
    """Return what a run must tell of the weights that it takes: training scans and files of all before it.

    Args:
        donors: run from which a stage is taken as it is, by the name of the stage.

    Returns:
        sources of training scans (``train``), files of imported weights (``files``), and the settings by which the
        stages that are not trained here were trained, None where they are not known (``training``).
    """
    folder = locate(preset.tokenizer_from or preset.stages_from or "")
    about = read_json(folder / RUN_FILE) if (folder / RUN_FILE).is_file() else {}
    theirs, before = about.get("preset") or {}, taken_over(about)
    trained = {} if about.get("files") else {**theirs.get("training", {}), **before["training"]}
    return {
        "train": sorted({*theirs.get("data", {}).get("train", [_UNKNOWN_SCANS]), *before["train"]}),
        "files": [*about.get("files", ()), *before["files"]],
        "training": {stage: trained.get(stage) for stage in donors},
    }


def taken_stages(preset: Preset, generator: Generator) -> dict[str, Objective]:
    """Return the trained stages that a preset takes from another run, once they are known to fit the generator.

    Those that the preset names in ``fine_tune`` are among them: their training starts from these weights. They may
    lack what :attr:`Objective.additions` add, which begins untrained, and may be of another sensor if its weights fit.
    The run may be of another generator if what they share learns by the same objective.
    """
    if preset.tokenizer_from is not None:
        if "tokenizer" not in generator.stages:
            got = f"tokenizer_from={preset.tokenizer_from} for {generator.public_name()!r}, which has no tokenizer"
            raise ConfigError(got, "a generator with one, such as lidargrit, maskgit or lidm", "leave it out")
        donor = load(Path(preset.tokenizer_from))
        _check(f"tokenizer_from={preset.tokenizer_from}", _Stage("tokenizer", generator), _Stage("tokenizer", donor))
        return {"tokenizer": donor.get_tokenizer()}
    if preset.stages_from is None:
        return {}
    donor = load(Path(preset.stages_from))
    shared = [stage for stage in generator.stages if stage in donor.stages]
    if type(donor) is not type(generator) and not _learn_alike(generator, donor, shared):
        raise ConfigError(
            f"stages_from={preset.stages_from}, a run of the generator {donor.public_name()!r}",
            f"a run of {generator.public_name()!r}",
            "choose another run"
            + (", or set tokenizer_from to take its tokenizer alone" if "tokenizer" in generator.stages else ""),
        )
    if unknown := sorted({*preset.train_anew} - {*generator.stages}):
        raise ConfigError(f"train_anew={unknown[0]}", f"one of {', '.join(generator.stages)}", "name a stage")
    if both := sorted({*preset.fine_tune} & {*preset.train_anew}):
        got, cure = f"{both[0]} in fine_tune and in train_anew", "take it out of one of them, as by train_anew=[]"
        raise ConfigError(got, "a stage that is trained further or from new weights", cure)
    if unknown := sorted({*preset.fine_tune} - {*shared}):
        names = ", ".join(stage for stage in shared if stage not in preset.train_anew)
        raise ConfigError(f"fine_tune={unknown[0]}", f"one of {names}", "name a stage that the run of stages_from has")
    stages = [stage for stage in shared if stage not in preset.train_anew]
    found = {}
    for name in stages:
        ours, theirs = _Stage(name, generator), _Stage(name, donor)
        _check(f"stages_from={preset.stages_from}", ours, theirs, name in preset.fine_tune)
        if name not in preset.fine_tune:
            _check_base(preset, ours)
        else:
            _restore(preset.stages_from, theirs)
        found[name] = theirs.objective
    return found


def _learn_alike(generator: Generator, donor: Generator, stages: Sequence[str]) -> bool:
    """Tell whether two kinds of generators share stages, and each of them is trained by the same objective."""
    return bool(stages) and all(type(generator.objective(one)) is type(donor.objective(one)) for one in stages)


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


def _restore(run: str, stage: _Stage) -> None:
    """Give an objective what a finished generator does not keep, such as a discriminator, where the run has it."""
    checkpoint = locate(run) / stage.name / CHECKPOINT_FILE
    if checkpoint.is_file():
        load_average(checkpoint, stage.objective)
    elif stage.objective.players:
        raise ConfigError(
            f"fine_tune={stage.name} without {checkpoint}, which has the trained discriminator",
            "the folder of the training with its checkpoints",
            f"name that folder, or set train_anew={stage.name}",
        )


def _check_base(preset: Preset, stage: _Stage) -> None:
    """Refuse a stage taken as it is whose training rested on networks that are to be trained."""
    trained = {"train_anew": preset.train_anew, "fine_tune": preset.fine_tune}
    for base in (name for name in stage.objective.over if name != stage.name):
        for setting in (setting for setting, names in trained.items() if base in names):
            raise ConfigError(
                f"{setting}={base} without {stage.name}, which learned from the {base} of {preset.stages_from}",
                f"both trained, or neither: the {stage.name} is of no use with another {base}",
                f"add {stage.name} to train_anew or fine_tune",
            )


def _check(setting: str, mine: _Stage, given: _Stage, trained: bool = False) -> None:
    """Refuse a stage whose sizes or sensor are not the generator's.

    Dropout, which belongs to the training before, and settings that sampling alone reads may differ. A stage that is
    trained further may lack its additions, and may be of another sensor if its weights fit this one.
    """
    stage, ours, theirs = mine.name, mine.settings, given.settings
    differing = [name for name in ours if ours[name] != theirs.get(name) and not name.endswith("dropout")]
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

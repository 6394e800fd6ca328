"""Trained stages of another run that a recipe takes as they are: recipe → objectives by the name of their stage."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lidargrit import configuration
from lidargrit.errors import ConfigError
from lidargrit.generators import Generator, load
from lidargrit.nn.objective import Objective
from lidargrit.training.config import Recipe


def taken_stages(recipe: Recipe, generator: Generator) -> dict[str, Objective]:
    """Return the trained stages that a recipe takes from another run, once they are known to fit the generator.

    Raises:
        ConfigError: a stage of other sizes, a run of another sensor, or of another kind of generator.
        CheckpointError: no finished run.
    """
    if recipe.tokenizer_from is not None:
        tokenizer = load(Path(recipe.tokenizer_from)).get_tokenizer()
        theirs = {"name": tokenizer.config.name(), **configuration.leaves(configuration.to_json(tokenizer.config))}
        same_rays = generator.sensor.same_rays(tokenizer.sensor)
        _check(f"tokenizer_from={recipe.tokenizer_from}", generator, "tokenizer", theirs, same_rays)
        return {"tokenizer": tokenizer}
    if recipe.stages_from is None:
        return {}
    donor = load(Path(recipe.stages_from))
    if type(donor) is not type(generator):
        raise ConfigError(
            f"stages_from={recipe.stages_from}, a run of the generator {donor.public_name()!r}",
            f"a run of {generator.public_name()!r}",
            "choose another run, or set tokenizer_from to take its tokenizer alone",
        )
    stages = [stage for stage in generator.stages if stage in donor.stages]
    for stage in stages:
        theirs, same_rays = _settings(donor, stage), generator.sensor.same_rays(donor.sensor)
        _check(f"stages_from={recipe.stages_from}", generator, stage, theirs, same_rays)
    return {stage: donor.objective(stage) for stage in stages}


def _check(setting: str, generator: Generator, stage: str, theirs: dict[str, Any], same_rays: bool) -> None:
    """Refuse a stage whose sizes or sensor are not the generator's."""
    ours = _settings(generator, stage)
    differing = [name for name in ours if ours[name] != theirs.get(name)]
    if differing or not same_rays:
        other = f"model.{stage}.{differing[0]}={theirs.get(differing[0])}" if differing else "data.sensor"
        raise ConfigError(
            f"{setting}, whose {stage} is another ({other})",
            f"one of this recipe's model.{stage} and sensor",
            "set them as there, or choose another run",
        )


def _settings(generator: Generator, stage: str) -> dict[str, Any]:
    """Return every setting of a stage's networks by its name, and the kind of tokenizer under ``name``."""
    settings = configuration.leaves(configuration.to_json(generator.config))
    found = {name.removeprefix(f"{stage}."): value for name, value in settings.items() if name.startswith(f"{stage}.")}
    return {"name": generator.get_tokenizer().config.name(), **found} if stage == "tokenizer" else found

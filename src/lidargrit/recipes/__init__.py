"""One experiment = one file: name → :class:`Recipe`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lidargrit import _discovery, configuration
from lidargrit.errors import ConfigError
from lidargrit.generators import load_class
from lidargrit.loading import DataConfig
from lidargrit.training import FitConfig, Recipe

_SCANS = 2000  # of each stage of a default recipe: minutes, not hours


def load_recipe(name: str, settings: Sequence[str] = ()) -> Recipe:
    """Return a recipe by its name, with settings changed as in ``training.tokenizer.batch_size=4``.

    The name of a generator that has no recipe of this name gives its default recipe, see :func:`default_recipe`.

    Raises:
        UnknownNameError: no such recipe and no such generator.
        ConfigError: an unknown setting or a value that does not fit, of which it names the nearest; or a folder.
    """
    if not is_recipe(name) and Path(name).is_dir():
        raise ConfigError(
            f"{name}, a folder that holds no finished run",
            "a recipe, or where systems are compared a finished run or samples",
            "see lidargrit list recipes; score scans with lidargrit evaluate (--tables: side by side)",
        )
    is_generator = is_recipe(name) and name not in _discovery.names("recipes")
    recipe = default_recipe(name) if is_generator else _discovery.load_instance("recipes", name, Recipe)
    return configuration.override(recipe, settings)


def is_recipe(name: str) -> bool:
    """Return whether :func:`load_recipe` knows a name, of a recipe or of a generator."""
    return name in (*_discovery.names("recipes"), *_discovery.names("generators"))


def default_recipe(generator: str) -> Recipe:
    """Return a recipe for a generator that has none: its default configuration, and minutes on simulated streets.

    Args:
        generator: name of the generator.

    Raises:
        ConfigError: the generator's configuration has a setting without a default.
    """
    cls, data = load_class(generator), DataConfig(train=("simulated:256:train",), val=("simulated:16:val",))
    try:
        config = cls.Config()
    except TypeError as error:
        wanted = f"a default for every setting of {cls.Config.__name__}"
        raise ConfigError(f"{generator} without a recipe ({error})", wanted, f"add recipes/{generator}.py") from None
    fit = FitConfig(
        scans=_SCANS,
        batch_size=4,
        learning_rate=1e-3,
        schedule="cosine",
        warmup_scans=100,
        average_over_scans=100,
        precision=cls.training_precision,
        validate_every=500,
        validation_scans=16,
        checkpoint_every=500,
    )
    stages = cls(config, data.load_sensor()).stages
    title = f"{generator} as its default configuration makes it, on simulated streets"
    return Recipe(title, generator, config, data, dict.fromkeys(stages, fit))

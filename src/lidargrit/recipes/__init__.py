"""One experiment = one file: name → :class:`Recipe`."""

from __future__ import annotations

from collections.abc import Sequence

from lidargrit import _discovery, configuration
from lidargrit.training import Recipe


def load_recipe(name: str, settings: Sequence[str] = ()) -> Recipe:
    """Return a recipe by its name, with settings changed as in ``training.tokenizer.batch_size=4``.

    Raises:
        UnknownNameError: no such recipe.
        ConfigError: an unknown setting or a value that does not fit; names the nearest.
    """
    return configuration.override(_discovery.load_instance("recipes", name, Recipe), settings)

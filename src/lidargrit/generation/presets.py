"""One experiment = one file: name → :class:`Preset`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lidargrit.core import configuration, discovery
from lidargrit.core.errors import ConfigError
from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.generator import load_class
from lidargrit.generation.settings import FitConfig, Preset

_SCANS = 2000  # of each stage of a default preset: minutes, not hours


def load_preset(name: str, settings: Sequence[str] = ()) -> Preset:
    """Return a preset by its name, with settings changed as in ``training.tokenizer.batch_size=4``.

    The name of a generator that has no preset of this name gives its default preset, see :func:`default_preset`.

    Raises:
        UnknownNameError: no such preset and no such generator.
        ConfigError: an unknown setting or a value that does not fit, of which it names the nearest; or a folder.
    """
    is_generator = name not in discovery.names("presets") and name in discovery.names("generators")
    if not is_generator and name not in discovery.names("presets") and Path(name).is_dir():
        raise ConfigError(
            f"{name}, a folder that holds no finished run",
            "a preset, or where systems are compared a finished run",
            "see lidargrit list presets; score samples with lidargrit evaluate (--tables: side by side)",
        )
    preset = default_preset(name) if is_generator else discovery.load_instance("presets", name, Preset)
    return configuration.override(preset, settings)


def default_preset(generator: str) -> Preset:
    """Return a preset for a generator that has none: its default configuration, and minutes on simulated streets.

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
        raise ConfigError(
            f"{generator} without a preset ({error})", wanted, f"add systems/{generator}/presets/{generator}.py"
        ) from None
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
    return Preset(title, generator, config, data, dict.fromkeys(stages, fit))

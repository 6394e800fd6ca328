"""The folder of a comparison: settings, costs and scores of all systems ⇄ table.json, which can be extended."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lidargrit.core.errors import ConfigError
from lidargrit.core.files import read_json, write_json
from lidargrit.data.prepared.config import DataConfig
from lidargrit.evaluation.compare import CompareConfig, as_json
from lidargrit.evaluation.evaluate import EvalConfig

TABLE = "table.json"
_CURE = "name the systems and settings once more: lidargrit compare OUT SYSTEM ..."


def write_table(folder: Path, systems: Sequence[str], comparison: CompareConfig, scores: Sequence[Path]) -> None:
    """Write ``table.json``, with every cell of the table; :func:`read_table` reads it."""
    settings = _settings(comparison)
    write_json(folder / TABLE, {"systems": list(systems), "settings": settings, "cells": as_json(scores)})


def read_table(folder: Path) -> tuple[list[str], CompareConfig]:
    """Return the systems of a folder and the settings under which they were compared."""
    if not (folder / TABLE).is_file():
        raise ConfigError(f"{folder}, which holds no {TABLE}", "the folder of a finished comparison", _CURE)
    try:
        data = read_json(folder / TABLE)
        systems, settings = [str(system) for system in data["systems"]], data["settings"]
        how = {"projection": "sensor", **settings["evaluation"]}  # which names only another one
        reading = DataConfig(**{name: how[name] for name in ("projection", "bad_points", "bad_scans")})
        comparison = CompareConfig(
            str(settings["reference"]),
            int(settings["num_samples"]),
            EvalConfig(str(settings["protocol"]), tuple(map(str, settings["metrics"])), data=reading),
            tuple(map(str, settings["preset_settings"])),
            float(settings["flops"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"{folder / TABLE}, which cannot be used ({error})", "what compare wrote", _CURE) from None
    if _settings(comparison) != settings:
        raise ConfigError(f"{folder / TABLE}, made with settings that no option names", "those of the command", _CURE)
    return systems, comparison


def _settings(comparison: CompareConfig) -> dict[str, Any]:
    return {
        "reference": comparison.reference,
        "num_samples": comparison.num_samples,
        "protocol": comparison.settings.protocol,
        "metrics": list(comparison.settings.metrics),
        "preset_settings": list(comparison.preset_settings),
        "flops": comparison.flops,
        "evaluation": comparison.settings.facts(),
    }

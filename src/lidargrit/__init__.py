"""LiDAR scans → tokens → new scans."""

import importlib
from typing import TYPE_CHECKING, Any

from lidargrit.core.version import __version__ as __version__

if TYPE_CHECKING:
    from lidargrit.api import (
        Observed,
        Scan,
        complete,
        evaluate,
        inspect,
        load,
        load_scan,
        load_sensor,
        open_model,
        project,
        raydrop,
        segment,
        simulate,
        torch_dataset,
        unproject,
        upsample,
    )

__all__ = [
    "Observed",
    "Scan",
    "complete",
    "evaluate",
    "inspect",
    "load",
    "load_scan",
    "load_sensor",
    "open_model",
    "project",
    "raydrop",
    "segment",
    "simulate",
    "torch_dataset",
    "unproject",
    "upsample",
]


def __getattr__(name: str) -> Any:
    """Load the functions on first use, so that ``lidargrit --help`` need not wait for torch."""
    if name not in __all__:
        raise AttributeError(f"module 'lidargrit' has no attribute {name!r}")
    return getattr(importlib.import_module("lidargrit.api"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]

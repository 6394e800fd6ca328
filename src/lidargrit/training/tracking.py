"""A run's TensorBoard files → a project on Weights & Biases."""

import hashlib
import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lidargrit.core import configuration
from lidargrit.core.errors import ConfigError
from lidargrit.core.processes import rank_and_world_size
from lidargrit.generation.settings import Preset


@contextmanager
def tracked(project: str, preset: Preset, folder: Path) -> Iterator[None]:
    """Send what is logged within the ``with`` block to a project on Weights & Biases; a resumed run is one run there.

    Args:
        project: name of the project; "" to send nothing.
    """
    if not project or rank_and_world_size(None, None)[0] > 0:  # of several processes the first one logs
        yield
        return
    wanted, cure = "the package wandb", "pip install 'lidargrit[wandb]', or leave --wandb out"
    try:
        wandb = importlib.import_module("wandb")  # an extra: nothing else needs it
        folder.parent.mkdir(parents=True, exist_ok=True)
        run = wandb.init(
            project=project,
            name=folder.name,
            id=hashlib.sha256(str(folder.resolve()).encode()).hexdigest()[:16],
            resume="allow",
            config=configuration.to_json(preset),
            dir=folder.parent,
            sync_tensorboard=True,
        )
    except ImportError:
        raise ConfigError(f"--wandb {project}, and no wandb", wanted, cure) from None
    except Exception as error:  # its client has many kinds, from a missing key to a broken line, and changes them
        reason = f"{type(error).__name__}: {str(error).partition(chr(10))[0][:100]}"
        cure = "log in with: wandb login, or set WANDB_MODE=offline"
        raise ConfigError(f"--wandb {project}, where {reason}", "a project that can be written to", cure) from None
    failed = 1
    try:
        yield
        failed = 0
    finally:
        run.finish(exit_code=failed)

"""A name on the Hugging Face hub → the folder into which its client has downloaded the files of a generator."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

from lidargrit.core.errors import CheckpointError


def download(name: str, revision: str | None, patterns: list[str]) -> Path:
    """Download files of a repository by the hub's own client, which keeps them in its cache.

    Args:
        name: name of the repository, "USER/REPOSITORY".
        revision: branch, tag or commit; None for the repository's main branch.
        patterns: names of the files wanted, of which ``*`` stands for any letters.

    Raises:
        CheckpointError: no name of a repository, no such repository, no connection, or no client installed.
    """
    wanted, cure = "a run's folder, or USER/REPOSITORY on the Hugging Face hub", "check the name"
    if not re.fullmatch(r"[\w.-]+/[\w.-]+", name):
        raise CheckpointError(f"{name}, which is no folder", wanted, cure)
    try:
        hub = importlib.import_module("huggingface_hub")  # an extra: nothing else needs it
        return Path(hub.snapshot_download(name, revision=revision, allow_patterns=patterns))
    except ImportError:
        got, cure = f"{name}, which is no folder here", "to fetch it from the hub: pip install 'lidargrit[hub]'"
    except Exception as error:  # its client has a dozen kinds, from a wrong name to a broken line, and changes them
        got = f"{name}, which cannot be fetched ({type(error).__name__}: {str(error).partition(chr(10))[0][:100]})"
    raise CheckpointError(got, wanted, cure)

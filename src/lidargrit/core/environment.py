"""Folders that environment variables name: $LIDARGRIT_CACHE, $XDG_CACHE_HOME and others → absolute paths."""

import os
from functools import cache
from pathlib import Path

from lidargrit.core.errors import ConfigError

CACHE_VARIABLE = "LIDARGRIT_CACHE"


def cache_folder() -> Path:
    """Return the folder of what can be made again: ``$LIDARGRIT_CACHE``, else ``lidargrit`` in the user's cache folder.

    The user's cache folder is ``$XDG_CACHE_HOME``, else ``~/.cache``.
    """
    return folder_in(CACHE_VARIABLE) or (folder_in("XDG_CACHE_HOME") or Path.home() / ".cache") / "lidargrit"


def folder_in(variable: str) -> Path | None:
    """Return the folder that an environment variable names, as an absolute path; None if it is empty or not set.

    ``~`` is the user's home, and a relative path counts from the folder in which this process first asked for it.
    """
    text = os.environ.get(variable, "")
    try:
        return _absolute(text) if text else None
    except RuntimeError:
        raise ConfigError(f"{variable}={text}", "a folder", "correct it, or unset it") from None


@cache
def _absolute(text: str) -> Path:
    return Path(text).expanduser().absolute()

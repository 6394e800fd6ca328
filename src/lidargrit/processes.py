"""Processes that share work: which of them this one is, and how to start one that runs no file of strangers.

``python -m`` and multiprocessing put the current folder first on the import path of what they start. A file ``json.py``
that lies among somebody's downloads would then run in place of Python's own module, with the user's rights.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from lidargrit.errors import ConfigError


def rank_and_world_size(rank: int | None = None, world_size: int | None = None) -> tuple[int, int]:
    """Return the number of this process, from 0, and the number of all processes that share the work.

    A number that is not given comes from ``RANK`` and ``WORLD_SIZE``, which launchers such as torchrun set. Without
    these, this process is alone: number 0 of 1.

    Raises:
        ConfigError: the numbers contradict each other.
    """
    rank, world_size = _from_environment("RANK", rank, 0), _from_environment("WORLD_SIZE", world_size, 1)
    if not 0 <= rank < world_size:
        raise ConfigError(f"rank {rank} of {world_size}", "0 <= rank < world size", "number the processes from 0")
    return rank, world_size


def module_command(module: str, *words: str) -> list[str]:
    """Return the command that runs a module of ours in a Python process of its own.

    The option is ``-P`` and not ``-I``: the latter would also ignore ``PYTHONPATH`` and packages that are installed
    for one user only, and so lose lidargrit itself where it is found by them.

    Args:
        module: name of the module.
        words: arguments of the module.

    Example:
        >>> module_command("lidargrit.loading", "folder")[1:]
        ['-P', '-m', 'lidargrit.loading', 'folder']
    """
    return [sys.executable, "-P", "-m", module, *words]


@contextmanager
def safe_multiprocessing() -> Iterator[None]:
    """Let processes that multiprocessing starts within the block begin with a safe import path.

    Its own helpers, such as the resource tracker, take no options; they read the environment.
    """
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["PYTHONSAFEPATH"]
        else:
            os.environ["PYTHONSAFEPATH"] = before


def _from_environment(name: str, given: int | None, default: int) -> int:
    text = os.environ.get(name, str(default)) if given is None else str(given)
    if not text.isdecimal():
        raise ConfigError(f"{name}={text!r}", "a whole number from 0", "correct it")
    return int(text)

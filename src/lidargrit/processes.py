"""Which of several processes this one is: the environment of a launcher → rank and world size."""

from __future__ import annotations

import os

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


def _from_environment(name: str, given: int | None, default: int) -> int:
    text = os.environ.get(name, str(default)) if given is None else str(given)
    if not text.isdecimal():
        raise ConfigError(f"{name}={text!r}", "a whole number from 0", "correct it")
    return int(text)

"""Processes that share work: rank and world size; starting processes that import nothing from the current folder.

``python -m`` and multiprocessing put the current folder first on the import path of what they start. A file ``json.py``
that lies among somebody's downloads would then run in place of Python's own module, with the user's rights.
"""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import active_children, get_context, parent_process
from multiprocessing.process import BaseProcess

from lidargrit.core.errors import ConfigError, DataError
from lidargrit.core.untrusted import PROCESSES_AT_MOST


def rank_and_world_size(rank: int | None = None, world_size: int | None = None) -> tuple[int, int]:
    """Return the number of this process, from 0, and the number of all processes that share the work.

    A number that is not given comes from ``RANK`` and ``WORLD_SIZE``, which launchers such as torchrun set. Without
    these, this process is alone: number 0 of 1.
    """
    rank, world_size = _from_environment("RANK", rank, 0), _from_environment("WORLD_SIZE", world_size, 1)
    if not 0 <= rank < world_size:
        raise ConfigError(f"rank {rank} of {world_size}", "0 <= rank < world size", "number the processes from 0")
    return rank, world_size


def module_command(module: str, *words: str) -> list[str]:
    """Return the command that runs a module of ours in a Python process of its own.

    The option is ``-P`` and not ``-I``: the latter would also ignore ``PYTHONPATH`` and packages that are installed
    for one user only, and so lose lidargrit itself where it is found by them.

    Example:
        >>> module_command("lidargrit.data.prepared", "folder")[1:]
        ['-P', '-m', 'lidargrit.data.prepared', 'folder']
    """
    return [sys.executable, "-P", "-m", module, *words]


@contextmanager
def process_pool(count: int, begin: Callable[[], None] | None = None) -> Iterator[ProcessPoolExecutor]:
    """Yield a pool of processes that import no file of the current folder.

    If the block fails or is interrupted, they are terminated. If this process is killed, they end by themselves: they
    would else go on to write into a folder that nobody holds any more.
    """
    if not 1 <= count <= PROCESSES_AT_MOST:
        raise ConfigError(
            f"{count} processes", f"1 to {PROCESSES_AT_MOST:,}", "choose about as many as there are cores"
        )
    before = {*active_children()}
    try:
        with _safe_import_path(), ProcessPoolExecutor(count, get_context("spawn"), _begin, (begin,)) as pool:
            try:
                yield pool
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                _terminate({*active_children()} - before)
                raise
    except BrokenProcessPool:
        cure = "look for what ended it, such as a lack of memory; the same command goes on"
        raise DataError("a process that died", "all to end well", cure) from None


def _terminate(processes: set[BaseProcess]) -> None:
    """Terminate processes and wait for their end; one that saves its work first may take up more, so tell it again."""
    while living := [process for process in processes if process.is_alive()]:
        for process in living:
            process.terminate()
        living[0].join(1)


def _begin(begin: Callable[[], None] | None) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the terminal sends Ctrl-C to all; the first process ends the others
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if begin is not None:
        begin()


def _end_with_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _safe_import_path() -> Iterator[None]:
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

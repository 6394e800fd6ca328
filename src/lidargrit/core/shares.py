"""Shares of a piece of work → each done once: by this process, by several, or on the machines of a Ray cluster.

What does a share is one plain function that can be repeated: it leaves what is there already. So a worker, a machine or
the command itself may die at any time, and the same share is done again by another.
"""

import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING, TypeVar
from urllib.parse import urlsplit

from lidargrit.core import reporting
from lidargrit.core.errors import ClusterError, DataError, LidarGritError, first_words
from lidargrit.core.processes import process_pool

if TYPE_CHECKING:
    from types import ModuleType

Share = TypeVar("Share")
Result = TypeVar("Result")

_RETRIES = 3  # of a share whose worker or machine died; the same command takes up what failed more often
_ANSWERS_WITHIN_S = 5.0
_LOOK_EVERY_S = 0.5
_CLUSTER = "a Ray cluster: auto on one of its machines, HOST:PORT, or ray://HOST:PORT"


def each_done(
    do: Callable[[Share], Result], shares: Sequence[Share], workers: int = 1, ray: str = "", on_gpus: bool = False
) -> Iterator[Result]:
    """Do every share, and yield what each returned when it is done, in any order.

    Args:
        do: function of a module that does one share and may be repeated; what it reports is heard here.
        workers: number of processes on this machine.
        ray: address of a Ray cluster that does it instead, whose machines see the same folders at the same paths.
        on_gpus: whether a share takes a GPU of its own, where the cluster has some.

    Raises:
        LidarGritError: what a share raised; no cluster answers, or workers died too often.
    """
    if ray:
        with connected(ray):
            yield from _by_ray(do, shares, on_gpus)
    elif min(workers, len(shares)) <= 1:
        yield from map(do, shares)
    else:
        with process_pool(workers) as pool:
            yield from pool.map(do, shares)


@contextmanager
def connected(address: str) -> "Iterator[None]":
    """Keep one connection to a Ray cluster for all that is done in the block; none without an address.

    Within another such block, or where the caller has connected already, that connection is used and kept.
    """
    known = sys.modules.get("ray")
    if not address or (known is not None and known.is_initialized()):
        yield
        return
    ray = _connect(address)
    try:
        yield
    finally:
        ray.shutdown()


def _by_ray(do: Callable[[Share], Result], shares: Sequence[Share], on_gpus: bool) -> Iterator[Result]:
    ray, heard = import_module("ray"), set[str]()
    try:
        needs = {"num_gpus": 1} if on_gpus and ray.cluster_resources().get("GPU") else {}
        task = ray.remote(num_cpus=1, max_retries=_RETRIES, **needs)(_done_in)
        sent, here = ray.put(do), os.getcwd()  # once, not with each share
        waiting = [task.remote(here, sent, share) for share in shares]
        while waiting:
            done, waiting = ray.wait(waiting, num_returns=len(waiting), timeout=_LOOK_EVERY_S)
            for result, told in ray.get(done):
                for text in dict.fromkeys(told):
                    if text not in heard:  # what a command says once, each worker says
                        reporting.message(text)
                heard.update(told)
                yield result
    except ray.exceptions.RayTaskError as error:
        if isinstance(error.cause, LidarGritError):
            raise error.cause from None
        if isinstance(error.cause, ImportError):
            got = f"machines of the cluster without a library ({first_words(error.cause)})"
            raise DataError(got, "lidargrit on each of them, in the same version", "install it there") from None
        raise
    except ray.exceptions.RayError as error:
        cure = "look for what ended it, such as a lack of memory; the same command goes on"
        raise ClusterError(
            f"a worker of the cluster that died ({first_words(error)})", "all to end well", cure
        ) from None


class _Notes(reporting.Reporter):
    def __init__(self) -> None:
        self.told: list[str] = []

    def message(self, text: str) -> None:
        self.told.append(text)


def _done_in(folder: str, do: Callable[[Share], Result], share: Share) -> tuple[Result, list[str]]:
    """Do a share on a machine of the cluster, in the folder from which the command was given: paths may start there.

    Returns:
        what it returned, and what it reported.
    """
    try:
        os.chdir(folder)
    except OSError as error:
        got = f"{folder}, which {socket.gethostname()} of the cluster cannot enter ({error.strerror})"
        raise DataError(got, "a folder that all its machines share", "give the command from such a folder") from None
    with reporting.to(notes := _Notes()):
        return do(share), notes.told


def _connect(address: str) -> "ModuleType":
    if address != "auto":
        _refuse_silent(address)
    try:
        ray = import_module("ray")
        import_module("ray.exceptions")
    except ImportError:
        raise DataError("--ray without the library ray", "it installed", "pip install 'lidargrit[ray]'") from None
    told_to_end = signal.getsignal(signal.SIGTERM)
    try:
        # Its own lines would come between ours.
        ray.init(address, log_to_driver=False, logging_level="ERROR")
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, told_to_end)  # which it has taken
    except (ConnectionError, RuntimeError, ValueError) as error:
        cure = "start one: ray start --head"
        raise DataError(f"--ray {address}, where none can be used ({first_words(error)})", _CLUSTER, cure) from None
    return ray


def _refuse_silent(address: str) -> None:
    """Refuse an address where nobody listens: the library would try for minutes."""
    try:
        parts = urlsplit(address if "://" in address else f"//{address}")
        host, port = parts.hostname, parts.port
        if not host or not port:
            raise ValueError("no host and port")
        socket.create_connection((host, port), _ANSWERS_WITHIN_S).close()
    except (OSError, ValueError) as error:
        got = f"--ray {address}, where no cluster answers ({first_words(error)})"
        raise DataError(got, _CLUSTER, "check the address, or start one: ray start --head") from None

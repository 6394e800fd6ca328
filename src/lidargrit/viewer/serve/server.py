"""Run folders → a page at an address of this machine, until somebody ends it."""

import contextlib
import errno
import logging
import socket
import tempfile
import threading
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from waitress import wasyncore
from waitress.server import create_server

from lidargrit.core.errors import LidarGritError, OutputError
from lidargrit.data.run_folder import PACKAGED, is_bundle, is_run
from lidargrit.generation.generator import load
from lidargrit.viewer.serve.application import ALL_ADDRESSES, LOOPBACK_NAMES, Application
from lidargrit.viewer.serve.jobs import JobQueue
from lidargrit.viewer.serve.requests import LIMITS, Limits

_THREADS = 4  # threads that answer requests: each takes milliseconds, because the worker process computes
_RESPONSE_BYTES = 1 << 30  # more than any response has; all of them are in memory already


class RunningServer(NamedTuple):
    """A server that listens.

    Args:
        stop: function that ends ``run`` from another thread, and with it all connections.
    """

    port: int
    queue: JobQueue
    run: Callable[[], None]
    stop: Callable[[], None]


def serve(
    runs: Sequence[Path],
    say: Callable[[str], None],
    host: str = "127.0.0.1",
    port: int = 8000,
    device: str = "",
    limits: Limits = LIMITS,
    opens: bool = False,
) -> None:
    """Serve a page to generate, complete, compare and save scans, until Ctrl-C.

    Args:
        runs: folders of finished runs.
        say: function that prints the address, and a warning where others reach it.
        host: address to listen at; a loopback one keeps the page to this machine.
        port: port to listen at; 0 for any that is free.
        limits: bounds on what clients may ask for.
        opens: whether to open the page in this machine's browser.
    """
    with open_server(runs, host, port, device, limits) as server:
        name = socket.gethostname() if host in ALL_ADDRESSES else host
        if host not in LOOPBACK_NAMES:
            say(
                f"WARNING: everybody who reaches {name} can use this machine's processor and memory, without a password"
            )
        more = " (where this name is not known, at this machine's numeric address)" if host in ALL_ADDRESSES else ""
        url = f"http://[{name}]:{server.port}" if ":" in name else f"http://{name}:{server.port}"
        say(f"open {url} in a browser{more}; Ctrl-C ends it")
        if opens:  # in a thread: a browser in the terminal ends only when somebody quits it
            threading.Thread(target=_open_page, args=(url, say), daemon=True).start()
        server.run()


@contextlib.contextmanager
def open_server(
    runs: Sequence[Path], host: str = "127.0.0.1", port: int = 0, device: str = "", limits: Limits = LIMITS
) -> Iterator[RunningServer]:
    """Yield a server that listens; at the end of the block it, its worker process and its files are gone.

    Args, Raises: as for :func:`serve`.
    """
    logging.getLogger("waitress.queue").setLevel(logging.ERROR)  # it logs every request that waits
    with (
        contextlib.closing(_listening(host, port)) as bound,
        _temporary_folder() as folder,
        JobQueue(runs, Path(folder), device, limits) as queue,
    ):
        # The listening one and those of the connections, as waitress wraps them; the types of its stubs are others.
        open_sockets: dict[int, Any] = {}
        server = create_server(
            Application(queue, host),
            map=open_sockets,
            sockets=[bound],
            threads=_THREADS,
            ident="lidargrit",
            connection_limit=limits.connections,
            max_request_header_size=16_384,
            max_request_body_size=limits.upload_bytes + 1,
            inbuf_overflow=limits.upload_bytes + 1,  # in memory: on a full disk waitress would hang up without a word
            outbuf_overflow=_RESPONSE_BYTES,  # the same
            channel_timeout=limits.idle_seconds,
            cleanup_interval=max(1, limits.idle_seconds // 3),
        )

        def close_all() -> None:
            wasyncore.close_all(open_sockets, ignore_all=True)

        def stop() -> None:
            trigger: Any = server.trigger  # pyright: ignore[reportAttributeAccessIssue]  the stubs know no trigger
            with trigger.lock:  # else a response that wakes the server now closes the pipe before it is written to
                trigger.thunks.append(close_all)  # called by the thread that runs the server
                trigger.pull_trigger()

        try:
            yield RunningServer(bound.getsockname()[1], queue, server.run, stop)
        finally:
            server.task_dispatcher.shutdown()
            close_all()


def _open_page(url: str, say: Callable[[str], None]) -> None:
    if not webbrowser.open(url):
        say(f"no browser was found on this machine: open {url} yourself")


def finished_runs(folder: Path, say: Callable[[str], object]) -> list[Path]:
    """Return the finished runs in a folder, sorted by name, and then the models in the package.

    Args:
        folder: folder of runs; may be missing.
        say: function that prints why a run is left out, as it cannot be read.
    """
    found = []
    for path in sorted(path for path in folder.glob("*") if is_run(path) or is_bundle(path)):
        try:
            load(path)
            found.append(path)
        except LidarGritError as error:
            say(f"left out: {path}: {error}")
    return [*found, *PACKAGED]


def _temporary_folder() -> tempfile.TemporaryDirectory[str]:
    try:
        return tempfile.TemporaryDirectory(prefix="lidargrit-serve-", ignore_cleanup_errors=True)
    except OSError as error:
        raise OutputError(
            f"no folder for temporary files ({error.strerror or error})",
            "a disk with room",
            "free some space, or name another folder in the environment variable TMPDIR",
        ) from None


def _listening(host: str, port: int) -> socket.socket:
    wanted, cure = "an address or a name of this machine", "such as 127.0.0.1 for this machine only"
    try:
        host.encode("idna")
    except UnicodeError:  # letters that no name of a machine has, or too many of them
        raise OutputError(f"the address {host}, which is none", wanted, f"correct --host, {cure}") from None
    try:
        return socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
    except OSError as error:
        reason = str(error.strerror).partition(" (")[0]
        got = f"{host} port {port}, where nothing can be served ({reason})"
        if error.errno in (errno.EADDRINUSE, errno.EACCES):  # taken, or one of those kept for the administrator
            raise OutputError(got, "a port that is free", "choose another one by --port") from None
        raise OutputError(got, wanted, f"choose another one by --host, {cure}") from None

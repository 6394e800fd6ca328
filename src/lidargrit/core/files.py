"""Atomic files, and folders that one process holds: text, JSON, tensors → disk."""

import fcntl
import hashlib
import json
import math
import os
import secrets
import socket
import stat
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from functools import lru_cache, wraps
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from lidargrit.core.errors import CheckpointError, ConfigError, HeldError, LidarGritError, OutputError, one_of
from lidargrit.core.untrusted import JSON_BYTES_AT_MOST, TEXT_BYTES_AT_MOST, parse_json

if TYPE_CHECKING:  # quick start of commands that only read and write JSON
    from torch import Tensor

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")

_PARTIALS = f".lidargrit-partial-{os.getuid()}"  # one a user: a shared folder such as /tmp has files of many
_ATTEMPTS = 1000  # to make a file that others may sweep away; some file systems can make none, and say so each time
_LOCK = "lock"  # among the partial files, held by the commands that write into the folder


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path; its file is renamed to ``path`` if the block ends well, and removed if it fails.

    Until then it lies in a hidden folder beside ``path`` and is called ``*.partial``, so that no program takes it for
    a finished file. What a killed process left there is removed by the next write into the same folder.

    Raises:
        OutputError: the disk is full or the folder cannot be written to; what stood at ``path`` still stands.
    """
    is_new = not os.path.exists(path.parent)  # False of a path that cannot be
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _partial_file(path.parent) as temporary:
            yield temporary
            with temporary.open("rb") as written:
                os.fsync(written.fileno())
            temporary.replace(path)
    except OSError as error:
        raise OutputError(
            f"'{error.strerror or error}' while writing {path}",
            "a folder with room that may be written to",
            "free some space or choose another folder; nothing that was there is lost",
        ) from error
    finally:
        if is_new:
            with suppress(OSError):  # it holds the file, as it should
                path.parent.rmdir()


@contextmanager
def claim_folder(folder: Path, shared: bool = False) -> Iterator[None]:
    """Lock a folder of results while a command writes into it; at the end no partial file is left below it.

    Args:
        folder: folder of results; made if it is missing.
        shared: allow others that claim it as shared too, such as several processes that sample into one folder.

    Raises:
        HeldError: another process holds the folder.
        OutputError: it cannot be written to, or at the end it turns out to have been removed meanwhile.
    """
    is_new = not folder.exists()
    try:
        lock = _lock(folder, fcntl.LOCK_SH if shared else fcntl.LOCK_EX)
    except OSError as error:
        raise OutputError(
            f"'{error.strerror or error}' for {folder}", "a folder that may be written to", "choose another folder"
        ) from error
    try:
        yield
        if not os.fstat(lock).st_nlink:  # only who removes the folder, or all in it, removes a lock that is held
            raise removed_meanwhile(folder)
    finally:
        os.close(lock)
        remove_partials(folder)
        if is_new:
            with suppress(OSError):  # it holds results, as it should
                folder.rmdir()


def removed_meanwhile(folder: Path) -> OutputError:
    """Return the error of a command whose files were removed while it still wrote others."""
    wanted = "a folder that nobody removes or empties while it is written"
    return OutputError(f"{folder}, from which files were removed meanwhile", wanted, "run the same command again")


def remove_partials(folder: Path) -> None:
    """Remove what killed processes left half-written anywhere below a folder; what living ones are writing stays."""
    for here, below, _ in os.walk(folder):
        for name in [name for name in below if is_partial(name)]:
            below.remove(name)
            _sweep(Path(here, name))


def is_partial(name: str) -> bool:
    """Return whether a name in a folder is that of the hidden folder of partial files."""
    return name.startswith(_PARTIALS[: _PARTIALS.rindex("-")])


@contextmanager
def _partial_file(folder: Path) -> Iterator[Path]:
    """Yield the path of a new file among the partial ones, locked while it is written."""
    path, lock = None, None
    try:
        attempts = count(1)
        while path is None:
            with _missing(next(attempts)):  # another process has just removed the hidden folder, empty
                new = _hidden(folder) / f"{secrets.token_hex(8)}.partial"
                lock = os.open(new, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    is_ours = os.fstat(lock).st_nlink > 0
                except BlockingIOError:  # a process that takes the file for an abandoned one is about to remove it
                    is_ours = False
                except OSError:  # a file system without locks
                    is_ours = True
                if is_ours:
                    path = new
                else:
                    os.close(lock)
                    lock = None
        yield path
    finally:
        if path is not None:
            with suppress(OSError):
                path.unlink(missing_ok=True)
        if lock is not None:
            os.close(lock)
        _sweep(folder / _PARTIALS)


def _lock(folder: Path, kind: int) -> int:
    """Lock a folder for this process, made if it is missing, and return the open lock file."""
    attempts = count(1)
    while True:
        with _missing(next(attempts)):  # who held it before may have just removed it, empty; else as in _partial_file
            folder.mkdir(parents=True, exist_ok=True)
            lock = os.open(_hidden(folder) / _LOCK, os.O_RDWR | os.O_CREAT, 0o666)
            try:
                fcntl.flock(lock, kind | fcntl.LOCK_NB)
            except BlockingIOError:
                holder = os.pread(lock, 200, 0).decode(errors="replace") or "another command"
                os.close(lock)
                raise HeldError(
                    f"{folder}, which {holder} is writing",
                    "a folder that no other process writes",
                    "wait for its end, or choose another folder",
                ) from None
            except OSError:  # a file system without locks
                return lock
            if os.fstat(lock).st_nlink:
                alone = kind == fcntl.LOCK_EX
                began = f"since {time.strftime('%Y-%m-%d %H:%M')}"
                holder = f"process {os.getpid()} on {socket.gethostname()} {began}" if alone else "another command"
                with suppress(OSError):  # a full disk; the lock holds all the same
                    os.ftruncate(lock, 0)
                    os.pwrite(lock, holder.encode(), 0)
                return lock
            os.close(lock)  # it was removed between the two calls


def _missing(attempt: int) -> AbstractContextManager[object]:
    """Ignore that a file or a folder has vanished; not for ever, where a file system cannot make one."""
    return suppress(FileNotFoundError) if attempt < _ATTEMPTS else nullcontext()


def _hidden(folder: Path) -> Path:
    """Return the hidden folder, made if it is missing; it may vanish again at once: see _sweep."""
    if not folder.is_dir():
        raise FileNotFoundError("the folder has been removed")
    hidden = folder / _PARTIALS
    with suppress(FileExistsError):
        hidden.mkdir()
    if folder.stat().st_mode & stat.S_ISVTX and hidden.lstat().st_uid != os.getuid():  # in /tmp strangers may set traps
        raise PermissionError(f"{hidden} belongs to another user")
    return hidden


def _sweep(hidden: Path) -> None:
    """Remove the files in a hidden folder that no living process has locked, then the folder if it is empty."""
    with suppress(OSError):
        for path in hidden.iterdir():
            with suppress(OSError):
                file = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK)
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    if os.fstat(file).st_nlink:  # else another process has removed it, and the name may be a new file's
                        path.unlink()
                finally:
                    os.close(file)
        hidden.rmdir()


def state_of(path: Path) -> tuple[int, int] | None:
    """Return the size of a file in bytes and its time in nanoseconds, of which one changes with it; None without it."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_size, status.st_mtime_ns


def remembered(
    files_of: Callable[..., Iterable[Path]], at_most: int = 64
) -> Callable[[Callable[_Arguments, _Result]], Callable[_Arguments, _Result]]:
    """Return a decorator of functions that read files: what was read is kept until one of the files changes.

    Args:
        files_of: function of the same arguments that names the files and folders; they need not be there.
        at_most: number of results that are kept.
    """

    def of_function(read: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
        @lru_cache(at_most)
        def known(_states: tuple[object, ...], *args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
            return read(*args, **kwargs)

        @wraps(read)
        def read_if_changed(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
            return known(tuple(map(state_of, files_of(*args, **kwargs))), *args, **kwargs)

        return read_if_changed

    return of_function


def is_taken(folder: Path) -> bool:
    """Return whether a folder holds anything but partial files, or is no folder at all."""
    if not folder.is_dir():
        return folder.exists()
    return any(not is_partial(path.name) for path in folder.iterdir())


def refuse_to_overwrite(path: Path | None, overwrite: bool, *endings: str) -> None:
    """Raise OutputError if something stands where a user's result is to be written, unless that is allowed.

    Also if a file stands where its folder should, a folder where the file should, or if its name has none of the
    endings of what may be in it.
    """
    above = None if path is None else next((parent for parent in path.absolute().parents if parent.exists()), None)
    if above is not None and not above.is_dir():
        raise OutputError(f"{path}, whose folder {above} is a file", "a folder", "choose another path")
    if path is not None and endings and path.suffix.lower() not in endings:
        kinds = one_of([ending[1:].upper() for ending in endings])
        raise OutputError(f"{path}, which will hold {kinds}", f"a name in {one_of(endings)}", "choose another name")
    if path is not None and path.is_dir():
        raise OutputError(f"{path}, which is a folder", "a file", "choose another name")
    if path is not None and path.exists() and not overwrite:
        raise OutputError(f"{path}, which is there already", "a new name", "choose another, or add --overwrite")


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_text(path: Path) -> str:
    """Read a text file that a user named, of at most :data:`lidargrit.core.untrusted.TEXT_BYTES_AT_MOST` bytes."""
    wanted, cure = "a text file in UTF-8", "check the path"
    try:
        return _read_bytes(path, ConfigError, wanted, cure, TEXT_BYTES_AT_MOST).decode("utf-8")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}, which cannot be read ({error})", wanted, cure) from None


def write_json(path: Path, data: Any) -> None:
    """Write a JSON file atomically; numbers that are NaN or infinite, for which JSON has no word, become null."""
    write_text(path, json.dumps(plain(data), indent=2, allow_nan=False) + "\n")


@contextmanager
def claimed_manifest(manifest: Path, *companions: Path) -> Iterator[None]:
    """Remove a new manifest, and its companions, again if nothing else was written beside it in the ``with`` block.

    Otherwise the folder would be refused to a corrected command, which does it in another way.
    """
    is_new = not manifest.exists()
    try:
        yield
    finally:
        with suppress(OSError):  # the folder was removed meanwhile
            ours = {manifest, *companions}
            if is_new and all(path in ours or is_partial(path.name) for path in manifest.parent.iterdir()):
                for path in ours:
                    path.unlink(missing_ok=True)


def plain(value: Any) -> Any:
    """Return a value of dicts and lists with null for every number that is NaN or infinite."""
    if isinstance(value, dict):
        return {name: plain(child) for name, child in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(child) for child in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def read_json(
    path: Path,
    kind: type = dict,
    error: type[LidarGritError] = CheckpointError,
    wanted: str = "a JSON file that lidargrit wrote",
    cure: str = "check the path, or restore the file",
    at_most: int = JSON_BYTES_AT_MOST,
) -> Any:
    """Read a JSON file of bounded size and depth; a pipe or a device is refused.

    The arguments are those of :func:`lidargrit.core.untrusted.parse_json`.
    """
    data = _read_bytes(path, error, wanted, cure, at_most)
    return parse_json(data, str(path), kind, error, wanted, cure, at_most)


def _read_bytes(path: Path, error: type[LidarGritError], wanted: str, cure: str, at_most: int) -> bytes:
    """Read at most one byte more than is allowed: no device or growing file fills the memory."""
    try:
        if not path.is_file():
            raise OSError("no such file" if not path.exists() else "not a file")
        with path.open("rb") as file:
            data = file.read(at_most + 1)
        if len(data) > at_most:
            raise OSError(f"more than {at_most:,} bytes")
        if not data and path.suffix == ".json":
            raise OSError("an empty file")
    except (OSError, ValueError) as why:
        raise _unreadable(error, path, why, wanted, cure) from None
    return data


def _unreadable(error: type[LidarGritError], path: Path, why: Exception, wanted: str, cure: str) -> LidarGritError:
    reason = why.strerror if isinstance(why, OSError) and why.strerror else why
    cure = "change its permissions" if isinstance(why, PermissionError) else cure
    return error(f"{path}, which cannot be read ({reason})", wanted, cure)


def sha256_of_json(data: Any) -> str:
    """Return the SHA-256 hash of plain values, whatever the order of names and the layout of their file."""
    return hashlib.sha256(json.dumps(plain(data), sort_keys=True).encode()).hexdigest()


def sha256_of(path: Path) -> str:
    """Return the SHA-256 hash of a file of any size, in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_tensors(path: Path, tensors: "Mapping[str, Tensor]", about: Mapping[str, Any] | None = None) -> None:
    """Write tensors and what is to be known about them into one safetensors file, atomically."""
    from safetensors import SafetensorError  # noqa: PLC0415  quick start of commands that write no weights
    from safetensors.torch import save  # noqa: PLC0415

    with atomic_path(path) as temporary:
        try:
            data = save(
                {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()},
                {"about": json.dumps(dict(about or {}))},
            )
        except SafetensorError as error:
            raise OSError(str(error)) from error
        temporary.write_bytes(data)  # its save_file would put another file, without our lock, in this one's place


def read_tensors(path: Path) -> "tuple[dict[str, Tensor], dict[str, Any]]":
    """Read tensors and what is known about them from a safetensors file."""
    from concurrent.futures import ThreadPoolExecutor  # noqa: PLC0415

    from safetensors import SafetensorError  # noqa: PLC0415

    cure = "restore the file, or remove it and train again"
    try:
        if not path.is_file():  # a pipe would hang
            raise OSError("no such file" if not path.exists() else "not a file")
        path.open("rb").close()  # the library calls a file that may not be read a missing one
        with ThreadPoolExecutor(1) as thread:  # the library takes an interrupt, which only the main thread gets, for
            return thread.submit(_opened_tensors, path).result()  # a damaged file
    except (OSError, SafetensorError, ValueError) as why:
        raise _unreadable(CheckpointError, path, why, "a complete safetensors file", cure) from None


def _opened_tensors(path: Path) -> "tuple[dict[str, Tensor], dict[str, Any]]":
    from safetensors import safe_open  # noqa: PLC0415

    with safe_open(path, framework="pt") as opened:
        about = parse_json((opened.metadata() or {}).get("about", "{}"), str(path))
        return {name: opened.get_tensor(name) for name in opened.keys()}, about  # noqa: SIM118  not a dict

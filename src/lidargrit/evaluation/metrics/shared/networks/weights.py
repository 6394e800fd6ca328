"""Published weights of a network → a file on this computer, downloaded if necessary → tensors."""

import gzip
import hashlib
import http.client
import io
import math
import tarfile
import time
import urllib.error
import urllib.request
import zlib
from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

from torch import Tensor

from lidargrit.core import reporting
from lidargrit.core.environment import cache_folder, folder_in
from lidargrit.core.errors import WeightsError
from lidargrit.core.files import atomic_path
from lidargrit.nn.published import RefusedFileError, float_tensors, read_bounded, unpickle

FOLDER_VARIABLE = "LIDARGRIT_WEIGHTS"
"""Environment variable with the folder that is looked into first."""

_TIMEOUT_S = 30.0  # without a byte: longer than any server that works takes to answer
_AGAIN_S = 60.0  # after a failure, for as long, nobody is asked again: every variant of every metric would wait
_CHUNK = 2**20  # bytes at a time: a progress bar that moves, and little memory

_failures: dict[str, tuple[float, str]] = {}  # by address: when, and why


@dataclass(frozen=True)
class PublishedWeights:
    """Address, licence and checksum of published weights.

    Args:
        name: name of the network in ``--weights NAME=FILE``.
        url: address of the file; https only.
        licence: terms of use that its publishers state.
        bytes_at_most: greatest size of the file, and of what it unpacks to; more is refused unread.
        sha256: checksum of the file if it is known; if not, only the layout of the file's content can be checked.
        members: files to read from a ``.tar.gz``, each with the prefix of the names of its tensors. Empty for a file of
            ``torch.save``.
    """

    name: str
    url: str
    licence: str
    bytes_at_most: int
    sha256: str | None = None
    members: dict[str, str] = field(default_factory=dict)

    @property
    def file_name(self) -> str:
        """The last part of the address."""
        return self.url.rpartition("/")[2]


def find_weights(published: PublishedWeights, given: Path | None = None) -> Path:
    """Return the file with the weights: the given one, else one that is there already, else download it to the cache.

    It is looked for in ``$LIDARGRIT_WEIGHTS`` and in ``weights`` in the cache, by the name that it has at its source.
    """
    if given is not None:
        return given
    folders = [folder for folder in (folder_in(FOLDER_VARIABLE), cache_folder() / "weights") if folder]
    for folder in folders:
        if (folder / published.file_name).exists():
            return folder / published.file_name
    target = folders[-1] / published.file_name
    _fetch(published, target)
    return target


def read_weights(published: PublishedWeights, path: Path) -> tuple[dict[str, Tensor], str]:
    """Read tensors by name, and nothing but tensors, from what may be anybody's file.

    Returns:
        the tensors, float32, in memory of their own, without the counters that networks in training keep; and the
        SHA-256 of the file.
    """
    try:
        data = read_bounded(path, published.bytes_at_most)
        checksum = hashlib.sha256(data).hexdigest()
        if published.sha256 not in {None, checksum}:
            raise _unfit(published, f"{path} with the SHA-256 {checksum}")
        parts = _members(published, data) if published.members else {"": data}
        tensors = {
            prefix + name: tensor
            for prefix, part in parts.items()
            for name, tensor in float_tensors(unpickle(part), published.bytes_at_most).items()
        }
    except RefusedFileError as why:
        raise _unfit(published, f"{path}, {why}") from None
    return tensors, checksum


def _members(published: PublishedWeights, data: bytes) -> dict[str, bytes]:
    """Return the wanted files of a ``.tar.gz`` by their prefixes; none is ever written to disk, so paths do no harm."""
    found: dict[str, bytes] = {}
    try:
        with (
            closing(_Bounded(gzip.GzipFile(fileobj=io.BytesIO(data)), published.bytes_at_most)) as unpacked,
            tarfile.open(fileobj=unpacked, mode="r|") as archive,
        ):
            for member in archive:
                prefix = published.members.get(member.name)
                if prefix is None or member.type not in {tarfile.REGTYPE, tarfile.AREGTYPE}:  # a sparse one may swell
                    continue
                if prefix in found:
                    raise RefusedFileError(f"which holds {member.name!r} twice")
                if member.size > published.bytes_at_most:
                    raise RefusedFileError(f"whose {member.name!r} is too large")
                reader = archive.extractfile(member)
                assert reader is not None  # it is for links only
                found[prefix] = reader.read()
    except (OSError, EOFError, tarfile.TarError, zlib.error, ValueError) as error:
        raise RefusedFileError(f"which is no whole .tar.gz ({error})") from None
    if missing := [name for name, prefix in published.members.items() if prefix not in found]:
        raise RefusedFileError(f"which lacks {' and '.join(map(repr, missing))}")
    return found


class _Bounded(io.RawIOBase):
    """A stream that refuses to give more than so many bytes: a small gzip may hold terabytes."""

    def __init__(self, stream: gzip.GzipFile, at_most: int) -> None:
        self._stream, self._left = stream, at_most

    def read(self, size: int = -1) -> bytes:
        data = self._stream.read(min(size, self._left + 1) if size >= 0 else self._left + 1)
        self._left -= len(data)
        if self._left < 0:
            raise RefusedFileError("which unpacks to too much")
        return data


def _fetch(published: PublishedWeights, target: Path) -> None:
    failed_s, why = _failures.pop(published.url, (-math.inf, ""))
    if time.monotonic() - failed_s < _AGAIN_S:
        _failures[published.url] = failed_s, why
        raise _missing(published, target, why)
    reporting.message(f"fetching {published.url} ({published.licence})")
    with atomic_path(target) as temporary:
        with temporary.open("wb") as file, closing(_received(published, target)) as chunks:
            for chunk in chunks:
                file.write(chunk)
        try:
            _, checksum = read_weights(published, temporary)
        except WeightsError:
            raise _missing(published, target, "what came is not what was asked for") from None
    if published.sha256 is None:
        reporting.message(f"{target}: SHA-256 {checksum}; none is known to compare it with")


def _received(published: PublishedWeights, target: Path) -> Generator[bytes, None, None]:
    request = urllib.request.Request(published.url, headers={"User-Agent": "lidargrit"})
    received = 0
    try:
        with urllib.request.build_opener(_HttpsOnly).open(request, timeout=_TIMEOUT_S) as response:
            promised = response.headers.get("Content-Length", "")
            expected = int(promised) if promised.isdecimal() else published.bytes_at_most
            with reporting.progress(f"{published.file_name}, MB", expected // 10**6) as progress:
                while chunk := response.read(_CHUNK):
                    before, received = received, received + len(chunk)
                    if received > published.bytes_at_most:
                        raise _missing(published, target, "the server sends too much")
                    progress.advance(received // 10**6 - before // 10**6)
                    yield chunk
    except (OSError, http.client.HTTPException) as error:
        reason = error.reason if isinstance(error, urllib.error.URLError) else error
        raise _missing(published, target, str(reason).replace("\n", " ") or type(error).__name__) from None
    if promised and promised != str(received):
        raise _missing(published, target, f"{received} of {promised} bytes came")


class _HttpsOnly(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, req, fp, code, msg, headers, newurl):
        if not newurl.startswith("https://"):
            raise urllib.error.URLError(f"the server points to {newurl}, which is not https")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _missing(published: PublishedWeights, target: Path, why: str) -> WeightsError:
    _failures.setdefault(published.url, (time.monotonic(), why))
    return WeightsError(
        f"no weights of {published.name} on this computer, and none from the network ({why})",
        f"{published.file_name} from {published.url} (licence: {published.licence})",
        f"put it into {target.parent} or ${FOLDER_VARIABLE}, or name it to evaluate: --weights {published.name}=FILE",
    )


def _unfit(published: PublishedWeights, got: str) -> WeightsError:
    known = f" with the SHA-256 {published.sha256}" if published.sha256 else ""
    return WeightsError(
        f"as weights of {published.name} {got}",
        f"{published.file_name} from {published.url}{known}",
        "remove the file and get it again",
    )

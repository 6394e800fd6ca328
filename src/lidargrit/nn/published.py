"""An untrusted file of torch.save → the tensors in it, by name, and nothing else."""

import io
import warnings
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lidargrit.core.errors import CheckpointError, ConfigError, kind_and_words

_ZIP, _PICKLE = b"PK\x03\x04", b"\x80"  # how files of torch.save begin: since version 1.6, and before it


class RefusedFileError(Exception):
    """Reason why a file is not read; it follows the file's name in a sentence."""


@contextmanager
def refused_as(path: Path, wanted: str, cure: str = "check which program saved it") -> Iterator[None]:
    """Tell in one line why a checkpoint of another program cannot be used, whatever it holds in place of weights."""
    try:
        yield
    except CheckpointError:
        raise
    except (RefusedFileError, OSError) as why:
        raise CheckpointError(f"{path}, {why}", wanted, cure) from None
    except ConfigError as error:
        raise CheckpointError(f"{path}, in which {error.got}", error.wanted, cure) from None
    except (ArithmeticError, AttributeError, LookupError, RuntimeError, TypeError, ValueError) as error:
        raise CheckpointError(f"{path}, which cannot be read ({kind_and_words(error)})", wanted, cure) from None


def read_checkpoint(
    path: Path, names: Sequence[str], bytes_at_most: int, ignored: Sequence[str] = ()
) -> dict[str, Tensor]:
    """Return the weights of one network in a checkpoint of another program.

    Args:
        names: names that lead to the weights, such as ``("G_ema",)``; nothing else in the file is read.
    """
    where = f"at {'.'.join(names)!r}" if names else "by name"
    with refused_as(path, f"a checkpoint with weights {where}", "check the path"):
        found = read_everything(path, bytes_at_most)
        for name in names:
            if not isinstance(found, dict) or name not in found:
                raise RefusedFileError(f"which holds no {name!r}")
            found = found[name]
        if isinstance(found, dict):
            found = {name: of for name, of in found.items() if not any(fnmatchcase(str(name), p) for p in ignored)}
        return float_tensors(found, bytes_at_most)


def read_everything(path: Path, bytes_at_most: int) -> Any:
    """Return all that a checkpoint of another program holds.

    Raises:
        RefusedFileError: no file, too large a one, or one that holds more than tensors, numbers and their containers.
        OSError: it cannot be read.
    """
    return unpickle(read_bounded(path, bytes_at_most))


def read_bounded(path: Path, bytes_at_most: int) -> bytes:
    """Return the bytes of a file, or raise RefusedFileError of no file or too large a one."""
    if not path.is_file():  # a pipe would hang
        raise RefusedFileError("which is no file")
    with path.open("rb") as file:
        data = file.read(bytes_at_most + 1)
    if len(data) > bytes_at_most:
        raise RefusedFileError(f"which is larger than {bytes_at_most / 1e6:.0f} MB")
    return data


def unpickle(data: bytes) -> Any:
    """Return what a file of torch.save holds; no code in it is run.

    Raises:
        RefusedFileError: it holds more than tensors, numbers and their containers, or more than it seems to.
    """
    if data.startswith(_ZIP):
        _refuse_swelling(data)
    elif not data.startswith(_PICKLE):
        raise RefusedFileError("which is no file of torch.save")
    try:
        with warnings.catch_warnings(action="ignore"):  # of pickles of another protocol: they fail or load
            return torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:  # whatever a stranger's file does to the reader, it is the file's fault
        raise RefusedFileError(f"which does not hold tensors only ({type(error).__name__})") from None


def float_tensors(loaded: object, bytes_at_most: int) -> dict[str, Tensor]:
    """Return float32 tensors by their names, in memory of their own, without the counters that training keeps."""
    if not isinstance(loaded, dict) or not all(isinstance(name, str) for name in loaded):
        raise RefusedFileError("which holds no tensors by name")
    tensors = {name: value for name, value in loaded.items() if not name.endswith("num_batches_tracked")}
    for name, value in tensors.items():
        # Numbers that lie nowhere, or are repeated to fill a large tensor, take no room in the file.
        plain = isinstance(value, Tensor) and value.layout == torch.strided and value.device.type == "cpu"
        if not plain or value.dtype != torch.float32 or 4 * value.numel() > bytes_at_most:
            raise RefusedFileError(f"whose {name!r} is no float32 tensor of a network")
    if 4 * sum(value.numel() for value in tensors.values()) > bytes_at_most:
        raise RefusedFileError("whose tensors are larger than the file could be")
    return {name: value.detach().contiguous() for name, value in tensors.items()}


def _refuse_swelling(data: bytes) -> None:
    """Refuse a zip that is more than it seems; PyTorch itself stores without compression."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = archive.infolist()
    except (zipfile.BadZipFile, ValueError, NotImplementedError) as error:
        raise RefusedFileError(f"which is no whole file of torch.save ({error})") from None
    if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
        raise RefusedFileError("whose tensors are compressed, as PyTorch does not write them")
    if sum(entry.file_size for entry in entries) > len(data):
        raise RefusedFileError("whose parts overlap")


def weights_below(weights: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Return the weights whose names begin with a prefix, by what follows it."""
    return {name.removeprefix(prefix): weight for name, weight in weights.items() if name.startswith(prefix)}

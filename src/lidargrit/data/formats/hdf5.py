"""HDF5 files with a dataset of points, or with x, y and z → :class:`Scan`."""

import importlib.util
import json
import os
import signal
import subprocess
import sys
import tempfile
from dataclasses import replace
from io import BytesIO
from pathlib import Path

from lidargrit.core.arrays import open_archive, read_arrays
from lidargrit.core.errors import ScanError, first_words, printable
from lidargrit.data.formats import BadPoints, damaged, first_bytes, open_file
from lidargrit.data.formats.shared import hdf5_child
from lidargrit.data.formats.shared.archive import columns_of_archive
from lidargrit.data.formats.shared.columns import BYTES_AT_MOST, ColumnFormat, scan_of_columns
from lidargrit.scans.types import Scan

_FORMAT = "an HDF5 file with a dataset of points (n, 3 to 5), or with x, y and z"
_MAGIC = b"\x89HDF\r\n\x1a\n"
_LETTERS_AT_MOST = 8_192  # of what the reader tells
_INSTALL = "pip install 'lidargrit[hdf5]'"
_KEPT = ("HOME", "LANG", "LC_ALL", "LC_CTYPE", "LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH", "PATH", "PYTHONHOME")
_KEPT += ("PYTHONPATH", "PYTHONUSERBASE")  # by which Python finds h5py; the reader sees nothing else of the environment
_OF_THE_READER = {
    "HDF5_PLUGIN_PRELOAD": "::",  # a file names filters, which the library would load as code
    "OPENBLAS_NUM_THREADS": "1",  # each thread takes memory
}


class Hdf5(ColumnFormat):
    """Datasets of one group by their names: points (or xyz, or x, y and z), intensity, ring, label and time.

    Several groups with points of one name are as many scans. Where datasets of several names may be points,
    ``FILE.h5:/group/points`` chooses (:meth:`of_topic`). The file is read by a process of its own, with limits, since
    the library is code that trusts what it reads.

    Source:
        The HDF5 file format, https://support.hdfgroup.org; read by the library h5py.
    """

    title = "HDF5 (.h5, .hdf5)"
    suffixes = (".h5", ".hdf5")
    several = True
    topics = True
    extra = "hdf5"

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether a file begins as HDF5."""
        return first_bytes(path, len(_MAGIC)) == _MAGIC

    @staticmethod
    def count(path: Path, topic: str = "") -> int:
        """Count the groups with points."""
        told = _answer(path, topic, -1)[:20].strip()
        if not told.isdigit() or int(told) > hdf5_child.OBJECTS_AT_MOST:
            raise _failed(path, "an answer that is no number")
        return int(told)

    @staticmethod
    def read(path: Path, index: int = 0, bad_points: BadPoints = "refuse", topic: str = "") -> Scan:
        """Read the scan of one group."""
        answer = _answer(path, topic, index)
        try:
            with open_archive(BytesIO(answer)) as archive:
                columns, names = columns_of_archive(archive, path, _FORMAT)
            left_out = read_arrays(BytesIO(answer), (hdf5_child.LEFT_OUT,), _LETTERS_AT_MOST)
        except ScanError:
            raise
        except ValueError as error:
            raise damaged(path, _FORMAT, error) from None
        scan = scan_of_columns(columns, path.with_name(f"{path.name}#{index}"), bad_points, names)
        told = tuple(f"left out: {printable(each.tobytes().decode('ascii', 'replace'))}" for each in left_out.values())
        return replace(scan, notes=(*scan.notes, *told))


def _answer(path: Path, topic: str, index: int) -> bytes:
    """Return what the process that reads the file writes."""
    open_file(path, _FORMAT).close()
    if not Hdf5.recognises(path):
        raise ScanError(f"{path}, which is no HDF5 file", _FORMAT, "check what wrote it")
    if importlib.util.find_spec("h5py") is None:
        raise ScanError(f"{path}, which takes h5py to read", "it installed", _INSTALL)
    command = [sys.executable, "-P", str(hdf5_child.__file__), str(path), topic, str(index)]
    kept = {name: os.environ[name] for name in _KEPT if name in os.environ}
    with tempfile.TemporaryFile() as answer:
        try:
            done = subprocess.run(
                command,
                stdin=subprocess.DEVNULL,
                stdout=answer,
                stderr=subprocess.PIPE,
                env={**kept, **_OF_THE_READER},
                timeout=hdf5_child.SECONDS,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise _too_slow(path) from None
        answer.seek(0)
        told = answer.read(2 * BYTES_AT_MOST)
    if done.returncode in (hdf5_child.REFUSED, hdf5_child.DAMAGED):
        got, cure = _two_words(told, path)
        if done.returncode == hdf5_child.DAMAGED:
            raise damaged(path, _FORMAT, ValueError(got))
        raise ScanError(f"{got} in {path}", _FORMAT, cure.replace(":/", f"{path.name}:/"))
    if done.returncode in (-signal.SIGALRM, -signal.SIGXCPU):
        raise _too_slow(path)
    if done.returncode:
        lines = done.stderr.decode("utf-8", "replace").strip().splitlines()
        raise _failed(path, first_words(ValueError(lines[-1])) if lines else f"signal {-done.returncode}")
    return told


def _two_words(told: bytes, path: Path) -> tuple[str, str]:
    """Return what was got and the cure, as the reader tells them, which hostile bytes may have changed."""
    try:
        got, cure = json.loads(told[:_LETTERS_AT_MOST])
        if isinstance(got, str) and isinstance(cure, str):
            return got, cure
    except (ValueError, TypeError, RecursionError):
        pass
    raise _failed(path, "an answer that is none")


def _failed(path: Path, what: str) -> ScanError:
    """Return the error of a reader that ended before it knew the file: the file may be good."""
    cure = "try again where more memory is free, or save the points as .npy"
    return ScanError(f"{path}, whose reader, a process of its own, failed ({what})", _FORMAT, cure)


def _too_slow(path: Path) -> ScanError:
    got = f"{path}, which takes over {hdf5_child.SECONDS} s to read"
    return ScanError(got, _FORMAT, "keep fewer or smaller datasets in a file")

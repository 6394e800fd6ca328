"""HDF5 files with a dataset of points, or with x, y and z → :class:`Scan`."""

import importlib.util
import json
import os
import subprocess
import sys
import tempfile
from io import BytesIO
from pathlib import Path

from lidargrit.core.arrays import open_archive
from lidargrit.core.errors import ScanError
from lidargrit.data.formats import BadPoints, damaged, first_bytes, open_file
from lidargrit.data.formats.shared import hdf5_child
from lidargrit.data.formats.shared.archive import columns_of_archive
from lidargrit.data.formats.shared.columns import BYTES_AT_MOST, ColumnFormat, scan_of_columns
from lidargrit.scans.types import Scan

_FORMAT = "an HDF5 file with a dataset of points (n, 3 to 5), or with x, y and z"
_MAGIC = b"\x89HDF\r\n\x1a\n"
_INSTALL = "pip install 'lidargrit[hdf5]'"
_SECONDS = 120.0
_WITHOUT_PLUGINS = {"HDF5_PLUGIN_PRELOAD": "::"}  # a file names filters, which the library would load as code


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
        return int(_answer(path, topic, -1))

    @staticmethod
    def read(path: Path, index: int = 0, bad_points: BadPoints = "refuse", topic: str = "") -> Scan:
        """Read the scan of one group."""
        answer = _answer(path, topic, index)
        try:
            with open_archive(BytesIO(answer)) as archive:
                columns, names = columns_of_archive(archive, path, _FORMAT)
        except ScanError:
            raise
        except ValueError as error:
            raise damaged(path, _FORMAT, error) from None
        return scan_of_columns(columns, path.with_name(f"{path.name}#{index}"), bad_points, names)


def _answer(path: Path, topic: str, index: int) -> bytes:
    """Return what the process that reads the file writes."""
    open_file(path, _FORMAT).close()
    if not Hdf5.recognises(path):
        raise ScanError(f"{path}, which is no HDF5 file", _FORMAT, "check what wrote it")
    if importlib.util.find_spec("h5py") is None:
        raise ScanError(f"{path}, which takes h5py to read", "it installed", _INSTALL)
    command = [sys.executable, "-P", str(hdf5_child.__file__), str(path), topic, str(index)]
    with tempfile.TemporaryFile() as answer:
        try:
            done = subprocess.run(
                command,
                stdin=subprocess.DEVNULL,
                stdout=answer,
                stderr=subprocess.PIPE,
                env={**os.environ, **_WITHOUT_PLUGINS},
                timeout=_SECONDS,
                check=False,
            )
        except subprocess.TimeoutExpired as error:
            raise damaged(path, _FORMAT, error) from None
        answer.seek(0)
        told = answer.read(2 * BYTES_AT_MOST)
    if done.returncode == 3:
        got, cure = json.loads(told)
        raise ScanError(f"{got} in {path}", _FORMAT, cure.replace(":/", f"{path.name}:/"))
    if done.returncode:
        lines = done.stderr.decode("utf-8", "replace").strip().splitlines()
        raise damaged(
            path, _FORMAT, ValueError(lines[-1] if lines else f"its reader ended by signal {-done.returncode}")
        )
    return told

"""A program of its own: names and arrays of an HDF5 file → an .npz on standard output, or one line on what is wrong.

It imports nothing of ours, so that it starts at once. A crash, or a flood of memory or time, of the library on hostile
bytes stays in it: it has limits on memory and time. It loads no plug-ins, and follows no link to another file.
"""

import io
import json
import resource
import signal
import sys
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING or __name__ == "__main__":  # whoever imports this program wants its numbers, and may have no h5py
    import h5py

BYTES_AT_MOST = 256_000_000  # of an array
SECONDS = 60  # less than the viewer's server gives a whole request, whose end this program would outlive
OBJECTS_AT_MOST = 10_000  # groups and datasets
REFUSED, DAMAGED = 3, 4  # exit codes
LEFT_OUT = "left out"  # array of letters: which datasets were left out, and why
_OF_SAVEZ = ("file", "allow_pickle")  # its own arguments, and no columns of points
_MEMORY_BYTES = 3 * 2**30
_NAMES = ("points", "xyz", "points_xyz_m", "data")  # of archive.py, too, which takes seconds to import, and data


class RefusedError(Exception):
    """What was got, and what to do."""


def main(path: str, wanted: str, index: int) -> None:
    """Print the arrays of one scan, or, for an index of -1, the number of scans."""
    with h5py.File(path, "r") as file:
        datasets, left_out = _datasets(file)
        scans = _scans(datasets, left_out, wanted)
        if index < 0:
            print(len(scans))
            return
        if index >= len(scans):
            raise RefusedError(f"scan number {index}, of {len(scans)}", "take another")
        arrays = {name: one[()] for name, one in scans[index].items()}
    if left_out and not wanted:
        arrays[LEFT_OUT] = np.frombuffer(_listed([what for what, _ in left_out.values()]).encode(), np.uint8)
    packed = io.BytesIO()
    np.savez(packed, **{name: array for name, array in arrays.items() if name not in _OF_SAVEZ})
    sys.stdout.buffer.write(packed.getvalue())


def _limit() -> None:
    signal.alarm(SECONDS)
    for limit, wanted in ((resource.RLIMIT_AS, _MEMORY_BYTES), (resource.RLIMIT_CPU, SECONDS)):
        hard = resource.getrlimit(limit)[1]
        most = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
        with suppress(ValueError, OSError):  # macOS has no limit on memory
            resource.setrlimit(limit, (most, most))


def _datasets(file: "h5py.File") -> "tuple[dict[str, h5py.Dataset], dict[str, tuple[str, str]]]":
    """Return the arrays of numbers in the file itself by their paths, and what was left out, why, and the cure."""
    found: dict[str, h5py.Dataset] = {}
    left_out: dict[str, tuple[str, str]] = {}
    count = 0

    def note(name: str, one: "h5py.HLObject") -> bool | None:
        nonlocal count
        count += 1
        if isinstance(one, h5py.Dataset) and one.shape:
            kinds = {one.dtype[field].base.kind for field in one.dtype.names or ()} or {one.dtype.kind}
            reason = _why_left_out(one)
            if kinds <= {*"fiu"} and not reason:
                found[f"/{name}"] = one
            elif reason and (one.ndim == 1 or _may_be_points(one)):
                left_out[f"/{name}"] = (f"/{name} {reason[0]}", reason[1])
        return count > OBJECTS_AT_MOST or None

    file.visititems(note)  # follows no link to another place or file
    return found, left_out


def _why_left_out(one: "h5py.Dataset") -> tuple[str, str] | None:
    """Return why a dataset is not read, and what to do; None if it is read."""
    size_bytes = one.size * one.dtype.itemsize
    if one.external or one.is_virtual:
        return f"({'in another file' if one.external else 'made of other datasets'})", "copy its values into the file"
    if size_bytes > BYTES_AT_MOST:
        above = f"({size_bytes / 1e6:,.0f} MB, above {BYTES_AT_MOST / 1e6:.0f} MB)"
        return above, "keep one revolution in a dataset"
    return None


def _scans(
    datasets: "dict[str, h5py.Dataset]", left_out: dict[str, tuple[str, str]], wanted: str
) -> "list[dict[str, h5py.Dataset]]":
    """Return the arrays of each scan: points, and what lies beside them in the same group and is as long."""
    may_be = [path for path, one in datasets.items() if _may_be_points(one)]
    if wanted in left_out:
        raise RefusedError(*left_out[wanted])
    if wanted and wanted not in datasets:
        cure = f"choose one: {_listed(may_be, ':')}" if may_be else "leave its name out"
        raise RefusedError(f"no dataset {wanted!a:.60}", cure)
    points = [wanted] if wanted else may_be
    usual = [path for path in points if path.rpartition("/")[2].lower() in _NAMES]
    points = points if len(points) < 2 else usual or points
    groups: dict[str, dict[str, h5py.Dataset]] = {}
    for path, one in datasets.items():
        group, _, name = path.rpartition("/")
        groups.setdefault(group, {})[name] = one
    axes = [] if points else sorted(group for group, beside in groups.items() if {*"xyz"} <= _lower(beside).keys())
    if not points and not axes:
        there = [*(f"{path} {one.shape}" for path, one in datasets.items()), *(what for what, _ in left_out.values())]
        cure = next((cure for _, cure in left_out.values()), "save x, y and z as columns of one")
        raise RefusedError(
            "no dataset of points" + (f" that can be read among {_listed(there)}" if there else ""), cure
        )
    if len({path.rpartition("/")[2] for path in points}) > 1:
        raise RefusedError(f"points perhaps in {_listed(points)}", f"choose one: {_listed(points, ':')}")
    scans = []
    for path in points or axes:
        beside = groups[path.rpartition("/")[0] if points else path]
        count = (datasets[path] if points else _lower(beside)["x"]).shape[0]
        arrays = {name: one for name, one in beside.items() if one.shape in ((count,), (count, 1))}
        scans.append({**arrays, **({"points": datasets[path]} if points else {})})
    return scans


def _lower(beside: "dict[str, h5py.Dataset]") -> "dict[str, h5py.Dataset]":
    return {name.lower(): one for name, one in beside.items()}


def _may_be_points(one: "h5py.Dataset") -> bool:
    names = {name.lower() for name in one.dtype.names or ()}
    return {*"xyz"} <= names or (one.dtype.kind == "f" and one.ndim == 2 and one.shape[1] in range(3, 6))


def _listed(words: list[str], before: str = "") -> str:
    return ", ".join(f"{before}{ascii(word)[1:-1]:.100}" for word in words[:5]) + (", ..." if words[5:] else "")


if __name__ == "__main__":
    _limit()
    try:
        main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
    except RefusedError as refusal:
        print(json.dumps(refusal.args))
        sys.exit(REFUSED)
    except MemoryError:
        raise  # by no fault of the file, perhaps
    except Exception as error:  # the library has no one error for damage
        print(json.dumps([f"{type(error).__name__}: {error}", ""]))
        sys.exit(DAMAGED)

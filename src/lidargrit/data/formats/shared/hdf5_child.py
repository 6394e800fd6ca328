"""A program of its own: names and arrays of an HDF5 file → an .npz on standard output, or one line on what is wrong.

It imports nothing of ours, so that it starts at once, and hostile bytes reach nothing but itself: it has limits on
memory and time, loads no plug-ins, and follows no link to another file.
"""

import io
import json
import resource
import sys

import h5py
import numpy as np

BYTES_AT_MOST = 256_000_000  # of arrays
_MEMORY_BYTES, _SECONDS = 3 * 2**30, 60
_OBJECTS_AT_MOST = 10_000  # groups and datasets
_NAMES = ("points", "xyz", "points_xyz_m", "data")


class RefusedError(Exception):
    """What was got, and what to do."""


def main(path: str, wanted: str, index: int) -> None:
    """Print the arrays of one scan, or, for an index of -1, the number of scans."""
    for limit, most in ((resource.RLIMIT_AS, _MEMORY_BYTES), (resource.RLIMIT_CPU, _SECONDS)):
        resource.setrlimit(limit, (most, most))
    with h5py.File(path, "r") as file:
        scans = _scans(_datasets(file), wanted)
        if index < 0:
            print(len(scans))
            return
        if index >= len(scans):
            raise RefusedError(f"scan number {index}, of {len(scans)}", "take another")
        arrays = {name: one[()] for name, one in scans[index].items()}
    packed = io.BytesIO()
    np.savez(packed, **arrays)
    sys.stdout.buffer.write(packed.getvalue())


def _datasets(file: h5py.File) -> dict[str, h5py.Dataset]:
    """Return the arrays of numbers that lie in the file itself, by their paths."""
    found: dict[str, h5py.Dataset] = {}
    count = 0

    def note(name: str, one: h5py.HLObject) -> bool | None:
        nonlocal count
        count += 1
        if isinstance(one, h5py.Dataset) and one.shape and not (one.external or one.is_virtual):
            kinds = {one.dtype[field].base.kind for field in one.dtype.names or ()} or {one.dtype.kind}
            if kinds <= {*"fiu"} and one.size * one.dtype.itemsize <= BYTES_AT_MOST:
                found[f"/{name}"] = one
        return count > _OBJECTS_AT_MOST or None

    file.visititems(note)  # follows no link to another place or file
    return found


def _scans(datasets: dict[str, h5py.Dataset], wanted: str) -> list[dict[str, h5py.Dataset]]:
    """Return the arrays of each scan: points, and what lies beside them in the same group and is as long."""
    if wanted and wanted not in datasets:
        raise RefusedError(f"no dataset {wanted!a:.60}", f"choose one: {_listed([*datasets], ':')}")
    points = [wanted] if wanted else [path for path, one in datasets.items() if _may_be_points(one)]
    usual = [path for path in points if path.rpartition("/")[2].lower() in _NAMES]
    points = points if len(points) < 2 else usual or points
    axes = [] if points else sorted(path[:-1] for path in datasets if path.endswith("/x"))
    axes = [group for group in axes if all(f"{group}{axis}" in datasets for axis in "yz")]
    if not points and not axes:
        shapes = [f"{path} {one.shape}" for path, one in datasets.items()]
        raise RefusedError(f"no dataset of points, but {_listed(shapes) or 'none'}", "save x, y, z as columns of one")
    if len({path.rpartition("/")[2] for path in points}) > 1:
        raise RefusedError(f"points perhaps in {_listed(points)}", f"choose one: {_listed(points, ':')}")
    scans = []
    for path in points or axes:
        group = path[: path.rfind("/") + 1]
        count = datasets[path if points else f"{group}x"].shape[0]
        beside = {at.removeprefix(group): one for at, one in datasets.items() if at.rpartition("/")[0] + "/" == group}
        arrays = {name: one for name, one in beside.items() if one.shape in ((count,), (count, 1))}
        scans.append({**arrays, **({"points": datasets[path]} if points else {})})
    return scans


def _may_be_points(one: h5py.Dataset) -> bool:
    names = {name.lower() for name in one.dtype.names or ()}
    return {*"xyz"} <= names or (one.dtype.kind == "f" and one.ndim == 2 and one.shape[1] in range(3, 6))


def _listed(words: list[str], before: str = "") -> str:
    return ", ".join(f"{before}{ascii(word)[1:-1]:.60}" for word in words[:5]) + (", ..." if words[5:] else "")


if __name__ == "__main__":
    try:
        main(sys.argv[1], sys.argv[2], int(sys.argv[3]))
    except RefusedError as refusal:
        print(json.dumps(refusal.args))
        sys.exit(3)

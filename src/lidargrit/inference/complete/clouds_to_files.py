"""Completed clouds → files: in a scan's own format with all that its file holds of every point, or in another one."""

from pathlib import Path

import numpy as np
from jaxtyping import Float64, Shaped
from torch import Tensor

from lidargrit.data import formats
from lidargrit.data.formats import ScanFormat
from lidargrit.data.scan_folder import IMAGE, TREE, writable_format, write_with_labels
from lidargrit.inference.complete.cloud import CompletedScan
from lidargrit.scans.columns import quantity_of
from lidargrit.scans.file_rows import FileRows
from lidargrit.scans.types import Scan

_AXES = ("x", "y", "z")
_UNWRITABLE = ".npz"  # for range images, and for scans whose own format cannot be written
_SAME = 1e-3  # of a column's largest value: rounding of what was scaled


def suffix_of(of_input: str, kind: str) -> str:
    """Return the ending of a completed scan's file.

    Args:
        of_input: ending of the scan's own file; "" if it is in none.
        kind: name or ending of the wanted format; "" for the scan's own.
    """
    if kind == IMAGE:
        return ".npy"
    if kind:
        return writable_format(kind, IMAGE, TREE)[1]
    known = formats.candidates(Path(f"scan{of_input}")) if of_input else ()
    return of_input if any(one.writes_columns() and of_input in one.suffixes for one in known) else _UNWRITABLE


def write_cloud(path: Path, kind: str, done: CompletedScan, form: type[ScanFormat] | None) -> bool:
    """Write a completed cloud, and return whether the file keeps its labels, if it has any.

    In the format of its own file, each row of that file stays as it is, with all columns, also one that is no return.
    Of an added point, columns that a scan has no room for have the value of the measured point nearest to its ray.

    Args:
        kind: name or ending of the wanted format; "" for the scan's own.
        form: format of the scan's file; None if it was in none.
    """
    whole = done.whole()
    if kind == TREE:
        write_with_labels(path, whole)
        return True
    named = [one for one in formats.candidates(path) if one.can_write()]
    wanted = writable_format(kind)[0] if kind else named[0]
    if not kind and form in named and form is not None:
        wanted = form
    if not wanted.writes_columns():
        wanted.write(path, whole)
    elif wanted is form and done.scan.rows is not None:
        wanted.write_columns(path, _rows_of_file(done, done.scan.rows, wanted))
    else:
        more, columns = _more_columns(done), wanted.columns_of(whole)
        if any(quantity_of(name) == "time" for name in more):  # in the file's own name and type
            columns.pop("time", None)
        wanted.write_columns(path, {**more, **columns})
    return whole.label is None or wanted.keeps_labels(path.name)


def _rows_of_file(done: CompletedScan, rows: FileRows, form: type[ScanFormat]) -> dict[str, np.ndarray]:
    """Return the columns of a file without the rows of dropped points, and with rows of those that were added."""
    stays = np.ones(len(next(iter(rows.columns.values()))), dtype=bool)
    stays[rows.of_point[~done.kept.numpy()]] = False
    kept = {name: values[stays] for name, values in rows.columns.items()}
    marks = np.zeros(len(stays), dtype=np.uint8)
    if done.scan.filled is not None:  # which may lie beside the file, and not in its rows
        marks[rows.of_point] = done.scan.filled.numpy()
    if done.filled is None:
        needs_none = done.scan.filled is None or "filled" in map(quantity_of, kept)
        return kept if needs_none else {**kept, "filled": marks[stays]}
    axes, nearest = form.columns_of(done.filled), rows.of_point[done.nearest_kept()]
    joined = {}
    for name, values in rows.columns.items():
        if quantity_of(name) == "filled":
            continue
        axis = axes.get(quantity_of(name)) if quantity_of(name) in _AXES else None
        added = _as_in_file(name, values, rows, done) if axis is None else axis
        joined[name] = _joined(kept[name], values[nearest] if added is None else added)
    return {**joined, "filled": _joined(marks[stays], np.ones(len(done.filled)))}


def _more_columns(done: CompletedScan) -> dict[str, np.ndarray]:
    """Return the times of each point as the scan's file has them, and columns that a scan has no room for."""
    rows = done.scan.rows
    if rows is None:
        return {}
    of_point = rows.of_point[done.kept.numpy()]
    if done.filled is not None:
        of_point = np.concatenate((of_point, rows.of_point[done.nearest_kept()]))
    return {name: values[of_point] for name, values in rows.columns.items() if quantity_of(name) in ("", "time")}


def _as_in_file(
    name: str, values: Shaped[np.ndarray, "N"], rows: FileRows, done: CompletedScan
) -> Float64[np.ndarray, "m"] | None:
    """Return a quantity of added points as the file's column has it, with its scale and its way to count rings."""
    quantity = quantity_of(name)
    own: dict[str, Tensor | None] = _quantities(done.scan)
    new: dict[str, Tensor | None] = {} if done.filled is None else _quantities(done.filled)
    of_scan, of_added = own.get(quantity), new.get(quantity)
    if of_scan is None or of_added is None:
        return None
    known, column = of_scan.double().numpy(), values[rows.of_point].astype(np.float64)
    low, high = int(known.argmin()), int(known.argmax())
    span = known[high] - known[low]
    factor = (column[high] - column[low]) / span if span else 1.0
    offset = column[low] - factor * known[low]
    if np.abs(factor * known + offset - column).max() > _SAME * max(1.0, float(np.abs(column).max())):
        return None  # another column of such a name, which the scan was not read from
    return factor * of_added.double().numpy() + offset


def _quantities(scan: Scan) -> dict[str, Tensor | None]:
    return {"reflectance": scan.reflectance, "ring": scan.ring, "label": scan.label}


def _joined(kept: Shaped[np.ndarray, "k"], added: Shaped[np.ndarray, "m"]) -> Shaped[np.ndarray, "k+m"]:
    """Return values of the kept ones' type; whole numbers are rounded."""
    added = added.round() if kept.dtype.kind in "iu" and added.dtype.kind == "f" else added
    return np.concatenate((kept, added.astype(kept.dtype)))

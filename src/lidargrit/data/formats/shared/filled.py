"""``NAME.filled`` beside a file of points without room for it: one byte a point, 1 where a model added the point."""

import os
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Shaped
from torch import Tensor

from lidargrit.core.errors import ScanError
from lidargrit.core.files import atomic_path
from lidargrit.data import formats

_SUFFIX = ".filled"


def marks_file(path: Path) -> Path:
    """Return where the marks of a file of points lie, if it has any."""
    return path.with_name(formats.stem(path) + _SUFFIX)


def read_marks(path: Path, count: int) -> Bool[Tensor, "n"] | None:
    """Return which points of a file a model added; None where no marks lie beside it."""
    beside = marks_file(path)
    if not os.path.isfile(beside):  # False, too, where its name would be too long
        return None
    wanted = f"a byte of 0 or 1 for each of the {count:,} points in {path.name}"
    marks = np.frombuffer(formats.read_bytes(beside, formats.POINTS_AT_MOST, wanted), np.uint8)
    if len(marks) != count or marks.max() > 1:
        got = f"{len(marks):,} bytes up to {marks.max()} in {beside}"
        raise ScanError(got, wanted, "complete the scan again, or move this file away")
    return torch.from_numpy(marks == 1)


def write_marks(path: Path, filled: Shaped[np.ndarray, "n"] | None) -> None:
    """Write the marks of a file of points, which is to be written after them: it says that the scan is complete."""
    if filled is not None:
        with atomic_path(marks_file(path)) as temporary:
            temporary.write_bytes(filled.astype(np.uint8).tobytes())

"""Bare float32 numbers of a file without a header ⇄ named columns, and how many of them make a point."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float32
from torch import Tensor

from lidargrit.core.errors import ScanError
from lidargrit.core.files import atomic_path
from lidargrit.data.formats import ScanFormat
from lidargrit.data.formats.shared.filled import marks_file, write_marks
from lidargrit.scans.file_rows import FileRows

_WIDTHS = range(3, 9)  # x, y, z to x, y, z, intensity, ring, time and two more
_FEW_NUMBERS, _WIDTHS_OF_FEW = 1024, range(3, 6)  # fewer do not show wider rows
# Twice as many numbers as a point has resemble one another little less than those of two points (0.99 in shuffled
# files). Where they do so far more, rows are as wide (0.44 to 0.71 with ring and time), or lasers of two halves of the
# sensor fire by turns (0.51, VLP-16): then both points of a pair lie in one direction.
_FAR_MORE = 0.9
_ONE_DIRECTION = 0.95  # mean cosine between azimuths; 0.997 to 1 for pairs of points, below 0.7 for other columns


class BareRowFormat(ScanFormat):
    """Files of float32 rows without a header, little-endian, with the marks of filled points beside them.

    Attributes:
        columns: names of the numbers of a row.
    """

    columns: ClassVar[tuple[str, ...]]

    @staticmethod
    def sidecar_files(path: Path) -> tuple[Path, ...]:
        """Return the marks of filled points."""
        return (marks_file(path),)

    @classmethod
    def write_columns(cls, path: Path, columns: Mapping[str, np.ndarray]) -> None:
        """Write rows to a new file, and the marks of filled points beside it."""
        rows = np.stack([columns[name] for name in cls.columns], axis=1).astype("<f4")
        write_marks(path, columns.get("filled"))
        with atomic_path(path) as temporary:
            temporary.write_bytes(rows.tobytes())


def row_width(values: Float32[np.ndarray, "n"]) -> int:
    """Return how many numbers make a point: after as many a file resembles itself most."""
    known = np.where(np.isfinite(values), values, 0)
    widths = _WIDTHS if len(values) >= _FEW_NUMBERS else _WIDTHS_OF_FEW
    differences = {width: _mean_difference(known, width) for width in widths if width < len(values)}
    width = min(differences, key=differences.__getitem__, default=3)
    half = width // 2
    if width % 2 or half not in differences:
        return width
    return half if differences[width] > _FAR_MORE * differences[half] or _are_two_points(known, half) else width


def wide_row(values: Float32[np.ndarray, "n"]) -> int:
    """Return how many numbers make a point if they are more than four; 0 if not, or if too few tell."""
    width = row_width(values) if len(values) >= _FEW_NUMBERS else 0
    return width if width > 4 else 0


def whole_rows(data: bytes, path: Path, width: int, layout: str, cure: str = "") -> Float32[Tensor, "n w"]:
    """Return the numbers of a file as rows of a point each.

    Args:
        width: numbers of a point.
        layout: rows that were wanted, in words, for an error.
        cure: beginning of the sentence on what helps, before a new download; "" if nothing else does.
    """
    if over := len(data) % (4 * width):
        raise ScanError(
            f"{len(data)} bytes in {path}, {over} more than whole points",
            layout,
            f"{cure}download it again: the file was cut short or is of another format",
        )
    return torch.from_numpy(np.frombuffer(bytearray(data), dtype="<f4").reshape(-1, width))


def columns_by_name(
    names: Sequence[str], rows: Float32[Tensor, "n w"], filled: Bool[Tensor, "n"] | None = None
) -> dict[str, np.ndarray]:
    """Return the numbers of every row by their names, with marks of filled points where there are some."""
    marks = {} if filled is None else {"filled": filled.numpy()}
    return {**dict(zip(names, rows.numpy().T, strict=True)), **marks}


def rows_of(names: Sequence[str], rows: Float32[Tensor, "N w"], kept: Bool[Tensor, "N"] | None = None) -> FileRows:
    """Return the rows of a file, of which those that are kept are the points of a scan; all if not given."""
    every = torch.arange(len(rows))
    return FileRows(columns_by_name(names, rows), (every if kept is None else every[kept]).numpy())


def _mean_difference(values: Float32[np.ndarray, "n"], step: int) -> float:
    """Return how far numbers are from those some places before them; infinite or no number in a damaged file."""
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.abs(values[step:] - values[:-step]).mean())


def _are_two_points(values: Float32[np.ndarray, "n"], width: int) -> bool:
    """Return whether each two rows begin with coordinates in one direction."""
    rows = values[: len(values) // (2 * width) * 2 * width].reshape(-1, 2, width).astype(np.float64)
    azimuth_rad = np.arctan2(rows[:, :, 1], rows[:, :, 0])
    return bool(np.cos(azimuth_rad[:, 1] - azimuth_rad[:, 0]).mean() > _ONE_DIRECTION)

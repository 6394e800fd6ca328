"""All that a file of points holds, row by row → :class:`FileRows`, by which it can be written again without loss."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int64, Shaped


@dataclass(frozen=True, eq=False)
class FileRows:
    """The rows of a file, with columns that a scan has no room for, and rows that are no points of it.

    Args:
        columns: values of every row (N), by the file's own names and in its own types.
        of_point: row of every point of the scan (n).
    """

    columns: Mapping[str, Shaped[np.ndarray, "N"]]
    of_point: Int64[np.ndarray, "n"]

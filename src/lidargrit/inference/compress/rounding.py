"""64-bit outputs of networks → integers that are the same on every machine, although the last bits differ."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

ATTEMPTS = 9


@dataclass(frozen=True)
class Grid:
    """Multiples that a kind of number is rounded to.

    Args:
        step: distance between two multiples, a power of 2.
        margin: distance from a rounding border within which another machine might round to the other side. The
            differences seen between machines, numbers of threads and libraries are a tenth of it or less.
    """

    step: float
    margin: float


MASK_LOGITS = Grid(2**-6, 1e-9)
WEIGHT_LOGITS = Grid(2**-5, 2e-10)
LOG_SCALES = Grid(2**-4, 2e-10)
CENTRES = Grid(2**-14, 2e-11)  # of ln(1 + range in metres): 1 mm at 20 m


class TooNearABorderError(Exception):
    """A number lies so near to a border that another machine might round it to the other side."""


@dataclass(frozen=True)
class Rounding:
    """Rounds to grids whose borders are shifted a little from attempt to attempt.

    Args:
        attempt: number from 0 to 8; 0 rounds to the nearest multiple.
        checked: whether numbers near a border are refused, as they are when a scan is compressed.
    """

    attempt: int
    checked: bool

    def indices(
        self, values: Float64[np.ndarray, "..."], grid: Grid, matters: Bool[np.ndarray, "..."] | None = None
    ) -> Int64[np.ndarray, "..."]:
        """Return the multiple that each number is rounded to.

        Args:
            values: numbers of one kind.
            grid: grid of their kind.
            matters: True where the number has an effect; everywhere if not given.
        """
        sign = 1 if self.attempt % 2 else -1
        shift = 0.5 + sign * ((self.attempt + 1) // 2) / 16
        shifted = values * (1 / grid.step) + shift
        whole = np.floor(shifted)
        if self.checked:
            beyond = shifted - whole
            near = np.minimum(beyond, 1 - beyond) * grid.step < grid.margin
            if bool((near if matters is None else near & matters).any()):
                raise TooNearABorderError
        return whole.astype(np.int64)

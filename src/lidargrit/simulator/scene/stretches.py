"""Stretches of a road that are laid out at once: what a drive begins with, the rest of it, and all that follows."""

from enum import Enum

import numpy as np
from jaxtyping import Bool, Float, Num

EXTENT_M = 125.0  # of the first stretch, to both sides: a little more than the 120 m that the sensor sees
LENGTH_M = 216.0  # of each further stretch: more than any sensor sees, and a whole number of every pattern of dashes


class Stretch(Enum):
    """Where the layout of a stretch puts things; u is counted from the stretch's middle.

    FIRST is dense around the place where our car begins, and thins out: each kind of thing has a distance of its own
    up to which it is laid out. REST lies between that distance and the end of the first stretch, for cars that drive
    on. FURTHER stretches are alike all along, and as dense as the first one is at its middle.
    """

    FIRST = "first"
    REST = "rest"
    FURTHER = "further"

    @property
    def half_m(self) -> float:
        """Distance from the middle of the stretch to its ends."""
        return LENGTH_M / 2 if self is Stretch.FURTHER else EXTENT_M

    @property
    def built_m(self) -> float:
        """Distance from the middle up to which houses stand; rows of houses have a gap where stretches meet."""
        return self.half_m - 1.0 if self is Stretch.FURTHER else self.half_m - 5.0

    def span(self, first_m: float) -> tuple[float, float]:
        """Return from where to where things are laid out that end ``first_m`` away in the first stretch."""
        match self:
            case Stretch.FIRST:
                return -first_m, first_m
            case Stretch.REST:
                return first_m, EXTENT_M
            case Stretch.FURTHER:
                return -LENGTH_M / 2, LENGTH_M / 2

    def share(self, first_m: float) -> float:
        """Return the length of :meth:`span` relative to that in the first stretch."""
        low, high = self.span(first_m)
        return (high - low) / (2 * first_m)

    def share_around(self, spread_m: float) -> float:
        """Return how many things :meth:`around` should place relative to the first stretch, where it is densest."""
        return 1.0 if self is Stretch.FIRST else self.share(_even_m(spread_m))

    def around(self, rng: np.random.Generator, spread_m: float, count: int) -> Float[np.ndarray, " n"]:
        """Sample positions: by a normal distribution in the first stretch, evenly in others."""
        if self is Stretch.FIRST:
            return rng.normal(0, spread_m, count)
        return rng.uniform(*self.span(_even_m(spread_m)), count)

    def keeps(self, u_m: Num[np.ndarray, " n"], first_m: float) -> Bool[np.ndarray, " n"]:
        """Return which positions :meth:`span` holds; further stretches have no position outside."""
        if self is Stretch.FURTHER:
            return np.ones(len(u_m), bool)
        return np.abs(u_m) < first_m if self is Stretch.FIRST else u_m >= first_m


def _even_m(spread_m: float) -> float:
    """Return half the width over which an even distribution is as dense as a normal one is at its middle."""
    return spread_m * float(np.sqrt(np.pi / 2))

"""What a street is built of: shapes, and how their surfaces answer a beam."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Surface:
    """How a surface answers a beam.

    Args:
        albedo: share of light scattered evenly, 0 to 1; paint and glass scatter very little.
        gloss: strength of the mirror-like lobe, seen only close to normal incidence.
        windows: which parts are glass: none, windows in the walls of a house, the sides of a cabin, or the belt of a
            car, whose top is a slanting windscreen.
    """

    albedo: float
    gloss: float = 0.0
    windows: Literal["none", "house", "cabin", "belt"] = "none"


@dataclass(frozen=True)
class Solid:
    """A vertical box, a vertical cylinder or an ellipsoid, in metres; heights count from the ground.

    Args:
        shape: which of the three; a cylinder and an ellipsoid are round with the radius ``half_length_m``.
        x_m: of the centre, forward.
        y_m: of the centre, left.
        yaw_rad: of the length, counter-clockwise from forward.
        half_length_m: half the extent along the yaw.
        half_width_m: half the extent across it.
        bottom_m: lower end above the ground.
        top_m: upper end above the ground.
        surface: how it answers a beam.
        free_path_m: mean way of a beam into a porous solid (leaves); 0 = not porous.
    """

    shape: Literal["box", "cylinder", "ellipsoid"]
    x_m: float
    y_m: float
    yaw_rad: float
    half_length_m: float
    half_width_m: float
    bottom_m: float
    top_m: float
    surface: Surface
    free_path_m: float = 0.0

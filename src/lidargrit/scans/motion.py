"""When and where a scan was made, and how its sensor moved from one scan to another."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float64
from torch import Tensor


class Motion(NamedTuple):
    """When and where a scan was made.

    Args:
        time_s: time in seconds, on one clock for all scans of a recording; None if it is not known.
        pose: matrix from the sensor's frame to that of the recording; None if it is not known.
    """

    time_s: float | None = None
    pose: Float64[Tensor, "4 4"] | None = None


def transform_between(then: Float64[Tensor, "4 4"], now: Float64[Tensor, "4 4"]) -> Float64[Tensor, "4 4"]:
    """Return the matrix from the sensor's frame at one pose to that at another, by sums in a fixed order.

    Args:
        then, now: matrices from the sensor's frame to that of the recording.
    """
    moved = then.clone()
    moved[:3, 3] -= now[:3, 3]
    products = now[:3, :3, None] * moved[:3, None]  # the inverse of a rotation is its transpose
    moved[:3] = products[0] + products[1] + products[2]
    return moved


def as_poses(turns: Float[np.ndarray, "*n 3 3"], places_m: Float[np.ndarray, "*n 3"]) -> Float64[np.ndarray, "*n 4 4"]:
    """Return poses: the matrices that turn by rotations, and then move by places in metres."""
    poses = np.zeros((*turns.shape[:-2], 4, 4))
    poses[..., :3, :3], poses[..., :3, 3], poses[..., 3, 3] = turns, places_m, 1
    return poses

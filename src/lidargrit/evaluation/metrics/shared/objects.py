"""Labelled range images → the vehicles, people, poles and trunks in them: where they stand, how long and how high."""

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
import torch
from jaxtyping import Float64, Int64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from lidargrit.scans.classes import BICYCLIST, CAR, CLASSES, MOTORCYCLIST, OTHER_VEHICLE, PERSON, POLE, TRUCK, TRUNK
from lidargrit.scans.projection import points_of_pixels
from lidargrit.scans.types import RangeImage

KINDS: Final[dict[str, frozenset[int]]] = {
    "vehicle": frozenset((CAR, TRUCK, OTHER_VEHICLE)),
    "person": frozenset((PERSON, BICYCLIST, MOTORCYCLIST)),
    "pole": frozenset((POLE,)),
    "trunk": frozenset((TRUNK,)),
}
"""Kinds of objects, and the benchmark's classes that each is of."""

LEAST_RETURNS: Final = 6  # of an object: fewer show neither its length nor its height
REACH_PIXELS: Final = 2  # rows and columns: a row of a car's windows often does not return
REACH_M: Final = 1.0  # of range, between two returns of one object: cars park closer than two of these
_DIRECTIONS = 8  # of the half circle: the longest extent along one of them is at most 2 % too short
_KIND_OF = torch.zeros(max(CLASSES) + 2, dtype=torch.int64)  # the last stands for all numbers from there on
for _index, _learned in enumerate(KINDS.values()):
    _KIND_OF[[number for number, each in CLASSES.items() if each.learned in _learned]] = _index + 1


class Objects(NamedTuple):
    """Objects of a batch of images, one after the other.

    Args:
        length_m: longest horizontal extent along one of eight directions.
        height_m: difference between the heights of the highest and the lowest return.
        distance_m: horizontal distance of the nearest return.
        upper_share: extent of its upper third, measured as its length is, as a share of its length: 1 of a box, about
            half of a car, whose cabin is shorter than its body.
    """

    image: Int64[np.ndarray, " n"]
    kind: Int64[np.ndarray, " n"]
    returns: Int64[np.ndarray, " n"]
    length_m: Float64[np.ndarray, " n"]
    height_m: Float64[np.ndarray, " n"]
    distance_m: Float64[np.ndarray, " n"]
    upper_share: Float64[np.ndarray, " n"]


def objects_in(images: RangeImage) -> Objects:
    """Find the objects in a batch of labelled images.

    Two returns of one kind belong together if they are at most two rows and two columns apart, in a circular row, and
    their ranges differ by at most a metre. An object is what hangs together so, of six returns or more.

    Args:
        images: batch of range images (B, H, W) with labels by SemanticKITTI's numbers.
    """
    assert images.label is not None
    label = images.label.long().clamp(0, len(_KIND_OF) - 1)
    kinds = torch.where(images.return_mask, _KIND_OF[label], 0).numpy()
    at = np.flatnonzero(kinds)
    place = np.full(kinds.size, -1)
    place[at] = np.arange(len(at))
    pairs = [*_neighbours(kinds, images.range_m.numpy())]
    first, second = (place[np.concatenate(ends)] for ends in zip(*pairs, strict=True))
    graph = coo_array((np.ones(len(first), bool), (first, second)), shape=(len(at), len(at)))
    count, component = connected_components(graph, directed=False)
    returns = np.bincount(component, minlength=count)
    order = np.argsort(component, kind="stable")
    order = order[returns[component[order]] >= LEAST_RETURNS]
    starts = np.flatnonzero(np.diff(component[order], prepend=-1))
    pixels = at[order]
    xyz_m = points_of_pixels(images).double().reshape(-1, 3).numpy()[pixels]
    return _measured(xyz_m, starts, pixels[starts] // kinds[0].size, kinds.ravel()[pixels[starts]] - 1)


def _neighbours(
    kinds: Int64[np.ndarray, "B H W"], range_m: np.ndarray
) -> Iterator[tuple[Int64[np.ndarray, " e"], Int64[np.ndarray, " e"]]]:
    """Yield the flat indices of both pixels of all pairs that belong together, for one step in the image after another.

    Steps to the left in the same row, or upwards, are those of the other pixel.
    """
    index = np.arange(kinds.size).reshape(kinds.shape)
    for down in range(REACH_PIXELS + 1):
        for right in range(-REACH_PIXELS if down else 1, REACH_PIXELS + 1):
            upper = slice(None, kinds.shape[1] - down if down else None)
            here = [each[:, upper] for each in (kinds, range_m, index)]
            there = [np.roll(each, -right, 2)[:, down:] for each in (kinds, range_m, index)]
            same = (here[0] > 0) & (here[0] == there[0]) & (np.abs(here[1] - there[1]) <= REACH_M)
            yield here[2][same], there[2][same]


def _measured(
    xyz_m: Float64[np.ndarray, "p 3"],
    starts: Int64[np.ndarray, " n"],
    image: Int64[np.ndarray, " n"],
    kind: Int64[np.ndarray, " n"],
) -> Objects:
    """Measure objects whose points lie one after the other, each object's from its start on."""
    returns = np.diff(starts, append=len(xyz_m))
    if not len(starts):
        none = np.zeros(0)
        return Objects(image, kind, returns, none, none, none, none)
    low_m, high_m = np.minimum.reduceat(xyz_m[:, 2], starts), np.maximum.reduceat(xyz_m[:, 2], starts)
    upper = xyz_m[:, 2] > np.repeat(high_m - (high_m - low_m) / 3, returns)
    length_m, upper_m = _extent_m(xyz_m, starts), _extent_m(np.where(upper[:, None], xyz_m, np.nan), starts)
    distance_m = np.minimum.reduceat(np.hypot(xyz_m[:, 0], xyz_m[:, 1]), starts)
    share = np.where(length_m > 0, upper_m / np.where(length_m > 0, length_m, 1), 1.0)
    return Objects(image, kind, returns, length_m, high_m - low_m, distance_m, share)


def _extent_m(xyz_m: Float64[np.ndarray, "p 3"], starts: Int64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Return the longest horizontal extent of each object along one of eight directions; points of NaN do not count."""
    angle_rad = np.arange(_DIRECTIONS) * np.pi / _DIRECTIONS
    along_m = xyz_m[:, :2] @ np.stack((np.cos(angle_rad), np.sin(angle_rad)))
    extents_m = np.fmax.reduceat(along_m, starts) - np.fmin.reduceat(along_m, starts)
    return np.nan_to_num(extents_m).max(1)  # an object of one height has no upper third

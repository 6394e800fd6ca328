"""Scans of a drive in a compressed file: when and where each was made ⇄ bytes, and the past that earlier ones tell."""

import struct
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Float64
from scipy.spatial.transform import Rotation
from torch import Tensor

from lidargrit.data.windows import TimedScan, drives_in
from lidargrit.inference.compress.coder import not_reproduced
from lidargrit.scans.fine_columns import in_fine_columns
from lidargrit.scans.motion import Motion, transform_between
from lidargrit.scans.past import Past
from lidargrit.scans.types import RangeImage

_PLACE = struct.Struct("<BI3i4h")
_PER_M, _PER_S, _TURN = 1000, 1000, 32767  # whole numbers of a metre, of a second, and of a quaternion's length
_ALONE_EVERY = 64  # scans of a drive: one is compressed by itself, so that a scan needs at most 63 others


class Place(NamedTuple):
    """When and where a scan was made, in whole numbers, so that every machine computes the same past from them.

    Args:
        before: number of scans directly before it in the file that are its past; 0 for a scan by itself.
        time_ms: time since the last scan by itself.
        position_mm: position in the frame of that scan.
        quaternion: orientation there, x, y, z and w times 32,767.
    """

    before: int = 0
    time_ms: int = 0
    position_mm: tuple[int, ...] = (0, 0, 0)
    quaternion: tuple[int, ...] = (0, 0, 0, _TURN)

    @classmethod
    def after(cls, first: Motion, now: Motion, before: int) -> "Place":
        """Return the place of a scan by its motion and that of the last scan by itself, both with time and pose."""
        assert first.pose is not None
        assert now.pose is not None
        moved = transform_between(now.pose, first.pose).numpy()
        turn = Rotation.from_matrix(moved[:3, :3]).as_quat()
        time_ms = round(((now.time_s or 0.0) - (first.time_s or 0.0)) * _PER_S)
        position_mm = tuple(round(float(each) * _PER_M) for each in moved[:3, 3])
        return cls(before, time_ms, position_mm, tuple(round(float(each) * _TURN) for each in turn))

    def to_bytes(self) -> bytes:
        """Return it as the bytes that come before those of the scan."""
        return _PLACE.pack(self.before, self.time_ms, *self.position_mm, *self.quaternion)

    @classmethod
    def split(cls, data: bytes) -> "tuple[Place, bytes]":
        """Return what :meth:`to_bytes` wrote at the beginning of bytes, and the rest."""
        if len(data) < _PLACE.size:
            raise not_reproduced()
        before, time_ms, *numbers = _PLACE.unpack_from(data)
        return cls(before, time_ms, tuple(numbers[:3]), tuple(numbers[3:])), data[_PLACE.size :]

    @property
    def pose(self) -> Float64[Tensor, "4 4"]:
        """Matrix to the frame of the last scan by itself, by products and quotients of whole numbers alone."""
        x, y, z, w = map(float, self.quaternion)
        length = x * x + y * y + z * z + w * w
        if not length:
            raise not_reproduced()
        turn = (
            (length - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
            (2 * (x * y + z * w), length - 2 * (x * x + z * z), 2 * (y * z - x * w)),
            (2 * (x * z - y * w), 2 * (y * z + x * w), length - 2 * (x * x + y * y)),
        )
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = torch.tensor(turn, dtype=torch.float64) / length
        pose[:3, 3] = torch.tensor(self.position_mm, dtype=torch.float64) / _PER_M
        return pose


class PlacedScan(NamedTuple):
    """A range image (H, W) of a drive, its ranges rounded to the step of the file, and its place."""

    place: Place
    image: RangeImage


def past_of(now: Place, before: Sequence[PlacedScan]) -> Past | None:
    """Return the past of a scan as scans of a file tell it, the latest last; None without any."""
    if not before:
        return None
    sensor = before[0].image.sensor
    range_m = in_fine_columns(RangeImage.stack([one.image for one in before]))[None]
    transforms = torch.stack([transform_between(one.place.pose, now.pose) for one in before])[None]
    ages_s = torch.tensor([[(now.time_ms - one.place.time_ms) / _PER_S for one in before]], dtype=torch.float64)
    return Past(range_m, transforms, ages_s, sensor)


class DrivesOfSource:
    """Which scans of a source come before each of its drive, if that has times and poses.

    Args:
        scans: number of past scans at most.
    """

    def __init__(self, timed: Sequence[TimedScan], scans: int) -> None:
        self._timed, self._scans = timed, scans
        self._first, self._before = list(range(len(timed))), [0] * len(timed)
        for drive in drives_in(timed):
            for at, (last, number) in enumerate(pairwise(drive), start=1):
                if at % _ALONE_EVERY and number == last + 1:  # in the file they lie one after the other
                    self._first[number], self._before[number] = self._first[last], self._before[last] + 1

    def before(self, number: int) -> range:
        """Return the numbers of the scans that may be a scan's past, the latest last."""
        return range(number - min(self._before[number], self._scans), number)

    def place(self, number: int, before: int) -> Place:
        """Return the place of a scan of which so many scans before it are the past."""
        first = self._first[number]
        if first == number:
            return Place()
        return Place.after(self._timed[first].motion, self._timed[number].motion, before)

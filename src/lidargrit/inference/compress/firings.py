"""Firings of a spinning sensor, as whole numbers → the ray of every laser at every firing, alike on all machines."""

import struct
import zlib
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from lidargrit.inference.compress.coder import not_reproduced

SLOPE, LENGTH_M, PHASE, MOTION = 2.0**-20, 1e-5, 2.0**-12, 1e-6  # what the whole numbers count
PIXELS_AT_MOST = 2**22  # lasers times firings: eight times those of any sensor
_NEAREST_M = 0.1
_HEAD = struct.Struct("<HHII6i")
_QUARTER_HIGH, _QUARTER_LOW = 1.57079632673412561417e00, 6.07710050650619224932e-11  # their sum is pi / 2

Points = Float64[np.ndarray, "n 3"]


class Rays(NamedTuple):
    """Where each pixel's laser looks: its points are ``origin_m + distance_m * direction``.

    Args:
        origin_m: (K, n, 3).
        direction: (K, n, 3), about as long as 1 in the sensor's plane, so that distances are nearly horizontal ones.
    """

    origin_m: Float64[np.ndarray, "K n 3"]
    direction: Float64[np.ndarray, "K n 3"]


@dataclass(frozen=True, eq=False)
class Firings:
    """A table of lasers and of the angles at which they fired, and how the sensor moved while it turned.

    The image of a revolution has a row for each laser, and a column for each firing. Rows are shifted so that pixels
    above one another look in about the same direction, though lasers of one firing do not.

    Args:
        units: number of units in which an encoder divides a revolution.
        fired: angles of all firings in units, rising.
        slope: tangent of each laser's elevation, in 2^-20.
        height: height of each laser above the origin, in 10 micrometres.
        aside: distance of each ray from the axis, in 10 micrometres.
        phase: angle that its rays are beside whole units, in 1/4096 of one.
        shift: whole units that are added to its angle to have the firing's.
        first: angle at which its points begin in the file, in 1/4096 of a unit.
        motion: translation in micrometres and turning in microradians in a revolution, by which the file was corrected.
    """

    units: int
    fired: Int64[np.ndarray, "n"]
    slope: Int64[np.ndarray, "K"]
    height: Int64[np.ndarray, "K"]
    aside: Int64[np.ndarray, "K"]
    phase: Int64[np.ndarray, "K"]
    shift: Int64[np.ndarray, "K"]
    first: Int64[np.ndarray, "K"]
    motion: Int64[np.ndarray, "6"]

    @property
    def shape(self) -> tuple[int, int]:
        """Number of lasers and of firings."""
        return len(self.slope), len(self.fired)

    def to_bytes(self) -> bytes:
        """Return all of it as bytes."""
        fired = np.zeros(self.units, dtype=bool)
        fired[self.fired] = True
        table = np.stack([self.slope, self.height, self.aside, self.phase, self.shift, self.first]).astype("<i4")
        planes = np.ascontiguousarray(table.view(np.uint8).reshape(6, -1, 4).transpose(0, 2, 1))
        packed = zlib.compress(np.packbits(fired).tobytes() + planes.tobytes(), 9)
        return _HEAD.pack(len(self.slope), self.units, len(self.fired), len(packed), *self.motion.tolist()) + packed

    @classmethod
    def split(cls, data: bytes) -> "tuple[Firings, bytes]":
        """Return what begins some bytes, and the rest of them; raise a ScanError if nothing does."""
        if len(data) < _HEAD.size:
            raise not_reproduced()
        lasers, units, columns, size, *motion = _HEAD.unpack_from(data)
        expected = (units + 7) // 8 + 24 * lasers
        if not (0 < lasers * columns <= PIXELS_AT_MOST and len(data) >= _HEAD.size + size):
            raise not_reproduced()
        try:
            plain = zlib.decompressobj().decompress(data[_HEAD.size :][:size], expected + 1)
        except zlib.error:
            raise not_reproduced() from None
        if len(plain) != expected:
            raise not_reproduced()
        fired = np.flatnonzero(np.unpackbits(np.frombuffer(plain[: -24 * lasers], np.uint8), count=units))
        planes = np.frombuffer(plain[-24 * lasers :], np.uint8).reshape(6, 4, lasers).transpose(0, 2, 1)
        table = np.ascontiguousarray(planes).view("<i4").reshape(6, lasers).astype(np.int64)
        if len(fired) != columns:
            raise not_reproduced()
        slope, height, aside, phase, shift, first = table
        found = cls(units, fired, slope, height, aside, phase, shift, first, np.array(motion))
        return found, data[_HEAD.size + size :]

    def beside(self) -> Int64[np.ndarray, "K"]:
        """Return by how many firings each row is shifted, so that its pixels lie below those of like azimuth."""
        return np.rint((self.shift + self.phase * PHASE) * self.shape[1] / self.units).astype(np.int64)

    def angles(self) -> Int64[np.ndarray, "K n"]:
        """Return the angle of every pixel in units, beside its laser's phase."""
        columns = self.shape[1]
        firing = (np.arange(columns) + self.beside()[:, None]) % columns
        return (self.fired[firing] - self.shift[:, None]) % self.units

    def order(
        self, row: Int64[np.ndarray, " m"], column: Int64[np.ndarray, " m"], distance_m: Float64[np.ndarray, " m"]
    ) -> Int64[np.ndarray, " m"]:
        """Return the order in which a file lists points of some pixels: by laser, and by azimuth from the origin."""
        beside = self.aside[row] * LENGTH_M / np.maximum(distance_m, _NEAREST_M) * (self.units / (2 * np.pi))
        since = self.angles()[row, column] + (self.phase - self.first)[row] * PHASE - beside
        return np.lexsort((since % self.units, row))

    def rays(self) -> Rays:
        """Return the ray of every pixel; by operations whose results IEEE 754 fixes."""
        units = self.angles() + (self.phase * PHASE)[:, None]
        cosine, sine = turn(units / self.units)
        slope = (self.slope * SLOPE)[:, None]
        height, aside = (self.height * LENGTH_M)[:, None], (self.aside * LENGTH_M)[:, None]
        direction = np.stack([cosine, sine, slope + np.zeros_like(cosine)], -1)
        origin_m = np.stack([aside * sine, -aside * cosine, height + np.zeros_like(cosine)], -1)
        if not self.motion.any():
            return Rays(origin_m, direction)
        shifted_m, turned = self.motion[:3] * MOTION, self.motion[3:] * MOTION
        share = units / self.units
        share = (share - np.floor(share + 0.5))[..., None]  # of a revolution, from behind to behind
        return Rays(_rotated(origin_m - share * shifted_m, -share * turned), _rotated(direction, -share * turned))


def _rotated(x: Float64[np.ndarray, "... 3"], by: Float64[np.ndarray, "... 3"]) -> Float64[np.ndarray, "... 3"]:
    """Return vectors turned by small rotation vectors: the series of the exponential, to the third power."""
    once = cross(by, x)
    twice = cross(by, once)
    return x + once + twice / 2 + cross(by, twice) / 6


def cross(a: Float64[np.ndarray, "... 3"], b: Float64[np.ndarray, "... 3"]) -> Float64[np.ndarray, "... 3"]:
    """Return cross products."""
    (ax, ay, az), (bx, by, bz) = np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)
    yz, zy, zx, xz, xy, yx = ay * bz, az * by, az * bx, ax * bz, ax * by, ay * bx
    return np.stack([yz - zy, zx - xz, xy - yx], -1)


def turn(turns: Float64[np.ndarray, "..."]) -> tuple[Float64[np.ndarray, "..."], Float64[np.ndarray, "..."]]:
    """Return cosine and sine of an angle in turns, within 1e-15, alike on all machines."""
    quarter = np.rint(turns * 4)
    rest = turns * 4 - quarter  # exact, from -0.5 to 0.5
    x = rest * (_QUARTER_HIGH + _QUARTER_LOW)
    square = x * x
    cosine, sine = np.ones_like(x), np.ones_like(x)
    for power in range(22, 0, -2):  # of Taylor's series, by Horner's scheme
        cosine = 1 - cosine * square / (power * (power - 1))
        sine = 1 - sine * square / (power * (power + 1))
    sine = sine * x
    which = quarter.astype(np.int64) % 4
    return (
        np.choose(which, [cosine, -sine, -cosine, sine]),
        np.choose(which, [sine, cosine, -sine, -cosine]),
    )

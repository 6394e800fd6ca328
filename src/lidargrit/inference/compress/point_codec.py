"""Points of a scan ⇄ bytes: every point comes back, each coordinate within half a step, by no model of learned weights.

Points on the firings of a spinning sensor are coded as distances along its rays (:mod:`firings`), by probabilities
that are learned on the way (:mod:`adaptive`); a small whole number along an axis corrects the few that lie beside. All
other points are cells of an octree (:mod:`cells`). A scan is coded by itself, and decoded alike on all machines.
"""

import hashlib
import struct
import zlib
from bisect import bisect_right
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int64

from lidargrit.core.errors import ScanError
from lidargrit.inference.compress.adaptive import Counts, Grid, code_image
from lidargrit.inference.compress.cells import BITS_AT_MOST, code_cells, code_numbers, order_of_cells
from lidargrit.inference.compress.coder import Coder, Decoder, Encoder, not_reproduced
from lidargrit.inference.compress.firings import Firings, Rays
from lidargrit.inference.compress.fit_firings import fit_firings

POINTS_AT_MOST = 2**23  # of a scan
_STEP_BITS = 20  # at most, of a number of steps along a ray
_HASH_BYTES = 8
_HEAD = struct.Struct("<IIBHBI4dB")
_SLACK_M = 1e-5
_SLACKS = np.array([0.0, 0.01, 0.02, 0.03, 0.05, 0.08, 0.12, 0.2, 0.3])  # of half a step
_BITS_OF_A_CORRECTION = 16
_CORRECTED_AT_MOST = 64  # steps along an axis; points farther off are cells
_SHARE_ON_RAYS = 0.5  # of the points: with fewer, all are cells
_MOVED_AT_MOST = 1 / 64  # of the points: with more, their order is not kept
_SCALES = (100, 255)  # in which reflectance is counted: KITTI's files have hundredths
_LANES = 64


class Cloud(NamedTuple):
    """The points of a scan.

    Args:
        points_m: coordinates (n, 3) in metres.
        reflectance: (n), in [0, 1]; None if there is none.
    """

    points_m: Float32[np.ndarray, "n 3"]
    reflectance: Float32[np.ndarray, "n"] | None


class _Head(NamedTuple):
    """What the decoder is told before the first decision."""

    on_rays: int
    rest: int
    step_bits: int  # of a number of steps
    slack: int  # in 10 micrometres: what is left of half a step for points beside their rays
    scale: int  # 0 without reflectance
    order_bytes: int
    half_m: float  # half a cell
    low_x_m: float
    low_y_m: float
    low_z_m: float
    bits: int  # of a cell's number along an axis


class _Known(NamedTuple):
    """What the encoder knows; points are in the order in which the decoder has them first."""

    steps: Int64[np.ndarray, "K n"] | None
    corrections: Int64[np.ndarray, "m 3"]
    cells: Int64[np.ndarray, "r 3"]
    reflectance: Int64[np.ndarray, "n"] | None


class PointCodec:
    """Compresses the points of scans, each scan by itself.

    Args:
        step_mm: twice as much as any coordinate may change, in millimetres.
    """

    def __init__(self, step_mm: int) -> None:
        self.step_mm, self._half_m = step_mm, step_mm / 2000
        Encoder()  # says at once if there is no range coder

    def compress(self, cloud: Cloud) -> bytes:
        """Return a cloud as bytes.

        Raises:
            ScanError: too many points, or too far apart for such small steps.
        """
        points_m = cloud.points_m.astype(np.float64)
        if len(points_m) > POINTS_AT_MOST or not np.isfinite(points_m).all():
            got = f"a scan of {len(points_m)} points{', some not finite' if len(points_m) <= POINTS_AT_MOST else ''}"
            raise ScanError(got, f"at most {POINTS_AT_MOST:,}, all finite", "leave the others out")
        half_m = _half_of_cells(self._half_m, cloud.points_m)
        on_rays = _OnRays.of(points_m, self._half_m, half_m)
        rest = np.arange(len(points_m)) if on_rays is None else np.flatnonzero(~on_rays.chosen)
        low_m, cells, bits = _cells(points_m[rest], half_m, self.step_mm)
        along = order_of_cells(cells, bits)
        source = rest[along] if on_rays is None else np.concatenate([on_rays.source, rest[along]])
        scale, reflectance = _counted(cloud.reflectance)
        order = _order_bytes(source)
        known = _Known(
            None if on_rays is None else on_rays.steps,
            np.zeros((0, 3), np.int64) if on_rays is None else on_rays.corrections,
            cells[along],
            None if reflectance is None else reflectance[source],
        )
        step_bits, slack = (0, 0) if on_rays is None else (int(on_rays.steps.max()).bit_length(), on_rays.slack)
        low_x_m, low_y_m, low_z_m = map(float, low_m)
        on, off = len(source) - len(rest), len(rest)
        head = _Head(on, off, step_bits, slack, scale, len(order), half_m, low_x_m, low_y_m, low_z_m, bits)
        firings, coder = None if on_rays is None else on_rays.firings, Encoder()
        found = self._code(coder, head, firings, known)
        restored = _in_order(found, order)
        packed = _HEAD.pack(*head) + (b"" if firings is None else firings.to_bytes()) + order
        return _hash(restored) + packed + coder.words()

    def decompress(self, compressed: bytes) -> Cloud:
        """Return the cloud that :meth:`compress` was given, each coordinate within half a step.

        Raises:
            ScanError: bytes that are not of a scan.
        """
        if len(compressed) < _HASH_BYTES + _HEAD.size:
            raise not_reproduced()
        head = _Head(*_HEAD.unpack_from(compressed, _HASH_BYTES))
        rest, firings = compressed[_HASH_BYTES + _HEAD.size :], None
        if head.on_rays:
            firings, rest = Firings.split(rest)
        order, words = rest[: head.order_bytes], rest[head.order_bytes :]
        least_m = 0.4 * self._half_m
        fits = head.on_rays + head.rest <= POINTS_AT_MOST and head.step_bits <= _STEP_BITS and head.bits <= BITS_AT_MOST
        sound = least_m < head.half_m <= self._half_m and head.slack * _SLACK_M < self._half_m
        if not (fits and sound and len(words) % 4 == 0 and head.scale in (0, *_SCALES)):
            raise not_reproduced()
        found = _in_order(self._code(Decoder(words), head, firings, None), order)
        if _hash(found) != compressed[:_HASH_BYTES]:
            raise not_reproduced()
        return found

    def _code(self, coder: Coder, head: _Head, firings: Firings | None, known: _Known | None) -> Cloud:
        """Code or decode a cloud, in one order; the cloud itself is given only to an encoder."""
        parts = list[Float64[np.ndarray, "m 3"]]()
        if firings is not None:
            parts.append(self._code_on_rays(coder, head, firings, known))
        if head.rest:
            cells = code_cells(coder, head.bits, head.rest, None if known is None else known.cells)
            low_m = np.array([head.low_x_m, head.low_y_m, head.low_z_m])
            parts.append(low_m + (2 * cells + 1) * head.half_m)
        with np.errstate(over="ignore", invalid="ignore"):  # of a stranger's numbers, which the hash refuses
            points_m = np.concatenate([np.zeros((0, 3)), *parts]).astype(np.float32)
        if not head.scale:
            return Cloud(points_m, None)
        counts = _code_reflectance(coder, len(points_m), None if known is None else known.reflectance)
        return Cloud(points_m, (counts / head.scale).astype(np.float32))

    def _code_on_rays(self, coder: Coder, head: _Head, firings: Firings, known: _Known | None) -> np.ndarray:
        rays = firings.rays()
        step_m = _steps_m(rays.direction, self._half_m - head.slack * _SLACK_M)
        steps = None if known is None else known.steps
        mask, steps = code_image(coder, Grid(step_m, head.step_bits), steps)
        at = row, column = np.nonzero(mask)
        if len(row) != head.on_rays:
            raise not_reproduced()
        distance_m = steps[at] * step_m[at]
        listed = firings.order(row, column, distance_m)
        at, distance_m = (row[listed], column[listed]), distance_m[listed]
        corrections = _code_corrections(coder, len(row), None if known is None else known.corrections)
        return rays.origin_m[at] + distance_m[:, None] * rays.direction[at] + corrections * (2 * head.half_m)


class _OnRays(NamedTuple):
    """Points that are coded along rays.

    Args:
        steps: number of steps of each pixel, -1 where nothing returned.
        corrections: cells by which each point is moved beside, in the order of the decoder.
        source: number of the point that each of them is, in the same order.
        chosen: True for points of the cloud that are among them.
    """

    firings: Firings
    slack: int
    steps: Int64[np.ndarray, "K n"]
    corrections: Int64[np.ndarray, "m 3"]
    source: Int64[np.ndarray, "m"]
    chosen: np.ndarray

    @classmethod
    def of(cls, points_m: Float64[np.ndarray, "n 3"], tolerance_m: float, half_m: float) -> "_OnRays | None":
        """Return what lies on the firings of a sensor; None if too little does."""
        fitted = fit_firings(points_m)
        if fitted is None:
            return None
        slacks = np.rint(_SLACKS * tolerance_m / _SLACK_M).astype(np.int64)
        rays, at = fitted.firings.rays(), (fitted.row, fitted.column)
        of_points = Rays(rays.origin_m[at], rays.direction[at])
        tried = [_Placed.of(points_m, of_points, (tolerance_m, half_m), int(slack)) for slack in slacks]
        bits = [
            -len(points_m) * np.log2(1 - slack * _SLACK_M / tolerance_m)
            + _BITS_OF_A_CORRECTION * int(placed.corrections.any(1).sum())
            for slack, placed in zip(slacks, tried, strict=True)
        ]
        best = int(np.argmin(bits))
        placed, firings = tried[best], fitted.firings
        pixel = fitted.row * firings.shape[1] + fitted.column
        good = np.flatnonzero(placed.good)
        kept = good[np.unique(pixel[good], return_index=True)[1]]
        if len(kept) < _SHARE_ON_RAYS * len(points_m):
            return None
        steps, chosen = np.full(firings.shape, -1, dtype=np.int64), np.zeros(len(points_m), dtype=bool)
        row, column = fitted.row[kept], fitted.column[kept]
        steps[row, column], chosen[kept] = placed.steps[kept], True
        source = kept[firings.order(row, column, placed.distance_m[kept])]
        return cls(firings, int(slacks[best]), steps, placed.corrections[source], source, chosen)


class _Placed(NamedTuple):
    """Points as steps along the rays of their pixels, and corrections; ``good`` where that is within the tolerance."""

    steps: Int64[np.ndarray, "n"]
    distance_m: Float64[np.ndarray, "n"]
    corrections: Int64[np.ndarray, "n 3"]
    good: np.ndarray

    @classmethod
    def of(cls, points_m: np.ndarray, rays: Rays, halves_m: tuple[float, float], slack: int) -> "_Placed":
        (origin_m, direction), (tolerance_m, half_m) = rays, halves_m
        step_m = _steps_m(direction, tolerance_m - slack * _SLACK_M)
        along_m = ((points_m - origin_m) * direction).sum(1) / (direction * direction).sum(1)
        steps = np.clip(np.rint(along_m / step_m), 0, 2**_STEP_BITS - 1).astype(np.int64)
        distance_m = steps * step_m
        on_ray_m = origin_m + distance_m[:, None] * direction
        beyond = np.abs(on_ray_m.astype(np.float32) - points_m) > tolerance_m
        cells = np.clip(np.rint((points_m - on_ray_m) / (2 * half_m)), -1e6, 1e6).astype(np.int64)
        corrections = np.where(beyond, cells, 0)
        found_m = (on_ray_m + corrections * (2 * half_m)).astype(np.float32).astype(np.float64)
        near = (np.abs(found_m - points_m) <= tolerance_m).all(1)
        return cls(steps, distance_m, corrections, near & (np.abs(corrections).max(1) <= _CORRECTED_AT_MOST))


def _steps_m(direction: Float64[np.ndarray, "... 3"], half_m: float) -> Float64[np.ndarray, "..."]:
    """Return steps along rays of which half one changes no coordinate by more than ``half_m``."""
    return 2 * half_m / np.abs(direction).max(-1)


def _half_of_cells(half_m: float, points_m: Float32[np.ndarray, "n 3"]) -> float:
    """Return half a cell's width so that its middle, in 32 bits, is within ``half_m`` of any point in it."""
    spacing_m = float(np.spacing(np.abs(points_m).max(initial=1e-3)))
    return max((half_m - spacing_m / 2) * (1 - 1e-6), 0.499 * half_m)


def _cells(points_m: Float64[np.ndarray, "n 3"], half_m: float, step_mm: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Return the lowest corner of points, their cells, and the bits of a cell's number."""
    if not len(points_m):
        return np.zeros(3), np.zeros((0, 3), dtype=np.int64), 0
    low_m = points_m.min(0)
    extent = float((points_m - low_m).max()) / (2 * half_m)
    if extent >= 2**BITS_AT_MOST - 1:
        got = f"points {(points_m - low_m).max() / 1000:.3g} km apart in steps of {step_mm} mm"
        raise ScanError(
            got, f"at most {2**BITS_AT_MOST:,} steps", "name larger steps by --step-mm, or leave far points out"
        )
    cells = ((points_m - low_m) / (2 * half_m)).astype(np.int64)
    return low_m, cells, int(cells.max()).bit_length()


def _counted(reflectance: Float32[np.ndarray, "n"] | None) -> tuple[int, Int64[np.ndarray, "n"] | None]:
    """Return the scale in which reflectance is counted, exactly if it can be, and the counts."""
    if reflectance is None:
        return 0, None
    for scale in _SCALES:
        counts = np.rint(reflectance.astype(np.float64) * scale).astype(np.int64)
        if ((counts / scale).astype(np.float32) == reflectance).all():
            return scale, counts
    return _SCALES[-1], np.rint(reflectance.astype(np.float64) * _SCALES[-1]).astype(np.int64)


def _code_corrections(coder: Coder, count: int, known: Int64[np.ndarray, "m 3"] | None) -> Int64[np.ndarray, "m 3"]:
    some, corrections = Counts(1), np.zeros((count, 3), dtype=np.int64)
    moved = np.zeros(count, dtype=bool)
    for first in range(0, count, 1024):
        part = slice(first, min(first + 1024, count))
        outcome = None if known is None else np.asarray(known[part].any(1))
        moved[part] = some.code(coder, np.zeros(part.stop - first, dtype=np.int64), outcome)
    folded = None if known is None else np.where(known < 0, -2 * known - 1, 2 * known)[moved].flatten()
    numbers = code_numbers(coder, 3 * int(moved.sum()), folded)
    corrections[moved] = np.where(numbers % 2, -(numbers + 1) // 2, numbers // 2).reshape(-1, 3)
    return corrections


def _code_reflectance(coder: Coder, count: int, known: Int64[np.ndarray, "n"] | None) -> Int64[np.ndarray, "n"]:
    """Code or decode 8-bit numbers, each by the two before it; several stretches of the points at once."""
    length = -(-count // _LANES)
    counts, values = Counts(32 * 8 * 256), np.zeros((_LANES, length), dtype=np.int64)
    padded = None if known is None else np.pad(known, (0, _LANES * length - count)).reshape(_LANES, length)
    before = further = np.zeros(_LANES, dtype=np.int64)
    for at in range(length):
        context, tree = before // 8 * 8 + further // 32, np.ones(_LANES, dtype=np.int64)
        for bit in range(7, -1, -1):
            outcome = None if padded is None else padded[:, at] >> bit & 1 == 1
            tree = tree * 2 + counts.code(coder, context * 256 + tree, outcome)
        further, before = before, tree - 256
        values[:, at] = before
    return values.flatten()[:count]


def _order_bytes(source: Int64[np.ndarray, " n"]) -> bytes:
    """Return which points are to be moved for the order of the file, and whereto; nothing if that is not kept.

    Args:
        source: number in the file of each point, in the order of the decoder.
    """
    tails, places = list[int](), list[int]()  # the longest rising sequence stays, by patience sorting
    for number in source.tolist():
        place = bisect_right(tails, number)
        tails[place : place + 1] = [number]
        places.append(place)
        if len(places) - len(tails) > 4 * _MOVED_AT_MOST * len(source) + 64:
            return b""
    stays, length = np.zeros(len(source), dtype=bool), len(tails) - 1
    for at in range(len(source) - 1, -1, -1):
        if places[at] == length:
            stays[at], length = True, length - 1
    moved = np.flatnonzero(~stays)
    if len(moved) > _MOVED_AT_MOST * len(source):
        return b""
    differences = np.diff(np.stack([moved, source[moved]]), axis=1, prepend=0).astype("<i4")
    return zlib.compress(differences.tobytes(), 9)


def _in_order(cloud: Cloud, order: bytes) -> Cloud:
    """Return the points in the order of the file, if that was kept."""
    count = len(cloud.points_m)
    if not order:
        return cloud
    try:
        plain = zlib.decompressobj().decompress(order, 8 * count + 1)
        moved, whereto = np.frombuffer(plain, "<i4").astype(np.int64).reshape(2, -1).cumsum(1)
    except (zlib.error, ValueError):
        raise not_reproduced() from None
    free, stays = np.ones(count, dtype=bool), np.ones(count, dtype=bool)
    for chosen, numbers in ((stays, moved), (free, whereto)):
        if len(numbers) and not 0 <= numbers.min() <= numbers.max() < count:
            raise not_reproduced()
        chosen[numbers] = False
    if stays.sum() != free.sum():
        raise not_reproduced()
    source = np.empty(count, dtype=np.int64)
    source[whereto], source[free] = moved, np.flatnonzero(stays)
    return Cloud(cloud.points_m[source], None if cloud.reflectance is None else cloud.reflectance[source])


def _hash(cloud: Cloud) -> bytes:
    found = hashlib.sha256(cloud.points_m.astype("<f4").tobytes())
    if cloud.reflectance is not None:
        found.update(cloud.reflectance.astype("<f4").tobytes())
    return found.digest()[:_HASH_BYTES]

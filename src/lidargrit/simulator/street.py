"""What stands in a street: random numbers → solids in the frame of a sensor, on a ground that slopes a little."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from lidargrit.simulator.solids import Solid, Surface

SENSOR_HEIGHT_M = 1.73  # of the Velodyne above the road, Geiger et al., IJRR 2013, figure 3
KERB_M = 0.12  # a common European kerb
_HALF_LENGTH_M = 115.0  # a little less than the 120 m that the sensor sees


@dataclass(frozen=True)
class Street:
    """A street around the sensor.

    Args:
        solids: all that stands on the ground.
        slope_x: rise of the ground per metre forward.
        slope_y: rise of the ground per metre to the left.
        yaw_rad: of the street at the sensor.
        curvature_per_m: of the street; its line is an arc.
        sensor_offset_m: of the sensor from the middle of the road, left is positive.
        half_road_m: from the middle of the road to the kerb.
    """

    solids: tuple[Solid, ...]
    slope_x: float
    slope_y: float
    yaw_rad: float
    curvature_per_m: float
    sensor_offset_m: float
    half_road_m: float

    def place(self, along_m: float, offset_m: float) -> tuple[float, float, float]:
        """Return x, y and the street's yaw at a way along the street and an offset to the left of its middle."""
        ahead = along_m
        left = offset_m - self.sensor_offset_m + self.curvature_per_m * along_m**2 / 2
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return cos * ahead - sin * left, sin * ahead + cos * left, self.yaw_rad + self.curvature_per_m * along_m


def draw_street(rng: np.random.Generator) -> Street:
    """Draw a street: facades with gaps, parked and driving cars, poles, trees, hedges, people, and a backdrop."""
    half_road = rng.uniform(4.2, 8.5)
    lane = min(half_road - 1.05 - rng.uniform(2.4, 3.2), rng.uniform(1.6, 3.0))  # clear of the cars parked on the right
    bare = Street(
        solids=(),
        slope_x=rng.normal(0, 0.008),
        slope_y=rng.normal(0, 0.006),
        yaw_rad=rng.normal(0, 0.04),
        curvature_per_m=rng.normal(0, 0.0015),
        sensor_offset_m=-lane,
        half_road_m=half_road,
    )
    builder = _Builder(bare, rng)
    crossing = rng.uniform(12, 60) * rng.choice([-1, 1])
    for side in (-1, 1):
        builder.facades(side, crossing)
        builder.pavement(side)
        builder.parked_cars(side)
    builder.traffic()
    builder.backdrop()
    return replace(bare, solids=tuple(builder.solids))


class _Builder:
    """Collects the solids of one street; its methods draw from one random stream, in the order they are called."""

    def __init__(self, street: Street, rng: np.random.Generator) -> None:
        self.street, self.rng = street, rng
        self.solids: list[Solid] = []
        self.pavement_m = rng.uniform(1.5, 4.5)
        self.gardens_m = float(rng.choice([0.0, rng.uniform(2, 10), rng.uniform(2, 10)]))
        self.green = rng.uniform(0, 1)  # how many trees and hedges

    def facades(self, side: int, crossing_m: float) -> None:
        """Set houses along one side, with gaps, and one gap where a side street crosses."""
        rng, along = self.rng, -_HALF_LENGTH_M
        line = self.street.half_road_m + self.pavement_m + self.gardens_m
        wall = rng.uniform(0.2, 0.55)
        while along < _HALF_LENGTH_M:
            length, depth = rng.uniform(7, 24), rng.uniform(8, 14)
            if along < crossing_m < along + length:
                along += rng.uniform(8, 13)
                continue
            front = line + rng.uniform(0, 1.0) + (rng.uniform(2, 10) if rng.random() < 0.2 else 0)
            height = rng.uniform(2.4, 3.2) if rng.random() < 0.12 else rng.uniform(6, 16)
            surface = Surface(float(np.clip(wall * rng.uniform(0.6, 1.4), 0.1, 0.8)), windows="house")
            self._box(along + length / 2, side * (front + depth / 2), length, depth, 0.0, height, surface)
            for step in np.arange(2, length, 5.0):  # bays and stairs break the plane of some houses
                if rng.random() < 0.15:
                    offset = side * (front - rng.uniform(0.1, 0.8))
                    self._box(along + step, offset, rng.uniform(0.8, 3), 1.0, 0.0, rng.uniform(1, 8), Surface(0.3))
            along += length
            if rng.random() < 0.55:
                gap = rng.uniform(2.5, 16)
                self._gap(along + gap / 2, side, gap, line)
                along += gap
        if self.gardens_m:
            self._fences(side, line - self.gardens_m + 0.3)

    def _gap(self, along_m: float, side: int, length_m: float, line_m: float) -> None:
        """Close some gaps between houses by a hedge or a wall, and grow trees behind."""
        rng = self.rng
        if rng.random() < 0.5:
            self._hedge(along_m, side * (line_m + 0.6), length_m, rng.uniform(1.0, 2.2))
        elif rng.random() < 0.5:
            self._box(along_m, side * (line_m + 0.3), length_m, 0.3, 0.0, rng.uniform(0.8, 2.4), Surface(0.35))
        for _ in range(rng.integers(0, 4)):
            self._tree(along_m + rng.uniform(-3, 3), side * (line_m + rng.uniform(3, 20)), low=True)

    def _fences(self, side: int, offset_m: float) -> None:
        """Line the front gardens with low hedges and walls, and bushes behind them."""
        rng, along = self.rng, -60.0
        while along < 60:
            length = rng.uniform(4, 15)
            if rng.random() < 0.35 + 0.3 * self.green:
                self._hedge(along + length / 2, side * offset_m, length, rng.uniform(0.7, 1.7))
            elif rng.random() < 0.5:
                self._box(along + length / 2, side * offset_m, length, 0.25, 0.0, rng.uniform(0.4, 1.3), Surface(0.35))
            if self.gardens_m > 3 and rng.random() < self.green:
                self._tree(along + length / 2, side * (offset_m + 1.8), low=bool(rng.random() < 0.6))
            along += length + rng.uniform(0.5, 4)

    def pavement(self, side: int) -> None:
        """Set lamp posts, signs, street trees and people on the pavement."""
        rng, edge = self.rng, self.street.half_road_m
        for along in np.arange(-75, 75, rng.uniform(7, 20)) + rng.uniform(0, 8):
            what, offset = rng.random(), side * (edge + rng.uniform(0.4, 0.8))
            if what < 0.15 + 0.5 * self.green:
                self._tree(float(along), offset, low=False)
            elif what < 0.8:
                self._round(float(along), offset, rng.uniform(0.04, 0.13), 0.0, rng.uniform(3, 9), Surface(0.25))
                if rng.random() < 0.4:  # a sign, whose foil throws the beam back
                    self._box(float(along), offset, 0.05, 0.65, rng.uniform(1.5, 2.3), 2.9, Surface(0.95))
        for _ in range(rng.poisson(1.0)):
            offset = side * (edge + rng.uniform(0.5, self.pavement_m))
            self._round(rng.uniform(-30, 30), offset, 0.24, 0.0, rng.uniform(1.5, 1.9), Surface(rng.uniform(0.05, 0.4)))

    def parked_cars(self, side: int) -> None:
        """Park cars along the kerb."""
        rng, taken, along = self.rng, self.rng.uniform(0.05, 0.85), -70.0
        if self.street.half_road_m < 4.8 and side < 0:
            return  # too narrow to pass
        while along < 70:
            if rng.random() < taken:
                self._car(along, side * (self.street.half_road_m - 1.05), float(rng.normal(0, 0.03)))
            along += rng.uniform(5.4, 8.0)

    def traffic(self) -> None:
        """Let cars drive in both lanes."""
        lane = self.street.sensor_offset_m
        for _ in range(self.rng.poisson(2.5)):
            oncoming = self.rng.random() < 0.5 and lane < -1.2  # a narrow street has one lane
            along = self.rng.uniform(9, 80) * self.rng.choice([-1, 1])
            self._car(along, -lane if oncoming else lane, math.pi if oncoming else 0.0)

    def backdrop(self) -> None:
        """Stand blocks and trees far behind the houses and at the ends of the street, so that the sky is not bare."""
        rng = self.rng
        for direction in np.linspace(0, 2 * math.pi, 14, endpoint=False):
            far = rng.uniform(45, 105)
            x, y = far * math.cos(direction), far * math.sin(direction)
            surface = Surface(rng.uniform(0.15, 0.5), windows="house")
            if abs(math.sin(direction)) > 0.45 or (abs(far) > 75 and rng.random() < 0.6):
                along, across, top = rng.uniform(5, 14), rng.uniform(5, 14), rng.uniform(7, 18)
                self.solids.append(Solid("box", x, y, rng.uniform(0, math.pi), along, across, 0.0, top, surface))
        for _ in range(rng.poisson(4 + 14 * self.green)):
            along = rng.uniform(30, 110) * rng.choice([-1, 1])
            self._tree(along, rng.uniform(9, 30) * rng.choice([-1, 1]), low=bool(rng.random() < 0.4))

    def _car(self, along_m: float, offset_m: float, turn_rad: float) -> None:
        """Set a car, body and cabin, or a van, unless it would stand on our own."""
        rng = self.rng
        if abs(along_m) < 6 and abs(offset_m - self.street.sensor_offset_m) < 2.4:
            return
        dark = rng.random() < 0.5
        albedo = float(np.exp(rng.normal(-6.3, 0.7))) if dark else rng.uniform(0.03, 0.3)
        paint = Surface(albedo, gloss=0.5)
        glazed, screen = replace(paint, windows="cabin"), replace(paint, windows="belt")
        if rng.random() < 0.12:
            length, width, height = rng.uniform(4.8, 6.5), 1.95, rng.uniform(1.9, 2.6)
            self._box(along_m, offset_m, length, width, 0.25, 1.1, paint, turn_rad)
            cab, forward = 1.7, -1 if abs(turn_rad) > 1 else 1  # glass in front, sheet metal behind
            self._box(along_m - forward * cab / 2, offset_m, length - cab, width - 0.1, 1.1, height, paint, turn_rad)
            at = along_m + forward * (length / 2 - cab / 2 - 0.4)
            self._box(at, offset_m, cab, width - 0.1, 1.1, height - 0.15, glazed, turn_rad)
            return
        length, width, height = rng.uniform(3.6, 4.8), rng.uniform(1.65, 1.85), rng.uniform(1.4, 1.6)
        belt = height * rng.uniform(0.58, 0.64)
        self._box(along_m, offset_m, length, width, 0.22, belt, paint, turn_rad)
        back = rng.uniform(0.05, 0.4) * (-1 if abs(turn_rad) < 1 else 1)
        middle = (belt + height) / 2
        self._box(along_m + back, offset_m, length * 0.66, width - 0.16, belt, middle, screen, turn_rad)
        self._box(along_m + back, offset_m, length * 0.52, width - 0.36, middle, height, glazed, turn_rad)

    def _tree(self, along_m: float, offset_m: float, low: bool) -> None:
        """Grow a trunk and a porous crown, or (low) a bush."""
        rng, leaves = self.rng, Surface(self.rng.uniform(0.15, 0.45))
        x, y, yaw = self.street.place(along_m, offset_m)
        if low:
            radius, top = rng.uniform(0.5, 1.8), rng.uniform(1.2, 4)
            self.solids.append(Solid("ellipsoid", x, y, yaw, radius, radius, -0.2 * top, top, leaves, 0.35))
            return
        radius, clear, top = rng.uniform(1.2, 3.2), rng.uniform(1.8, 3.0), rng.uniform(5, 10)
        self._round(along_m, offset_m, rng.uniform(0.08, 0.25), 0.0, clear + 1, Surface(0.2))
        self.solids.append(Solid("ellipsoid", x, y, yaw, radius, radius, clear, top, leaves, 0.8))

    def _hedge(self, along_m: float, offset_m: float, length_m: float, height_m: float) -> None:
        x, y, yaw = self.street.place(along_m, offset_m)
        leaves = Surface(self.rng.uniform(0.15, 0.4))
        self.solids.append(Solid("box", x, y, yaw, length_m / 2, 0.45, 0.0, height_m, leaves, 0.12))

    def _round(self, along_m: float, offset_m: float, radius_m: float, low: float, high: float, of: Surface) -> None:
        x, y, yaw = self.street.place(along_m, offset_m)
        self.solids.append(Solid("cylinder", x, y, yaw, radius_m, radius_m, float(low), high, of))

    def _box(
        self,
        along_m: float,
        offset_m: float,
        length_m: float,
        width_m: float,
        low: float,
        high: float,
        of: Surface,
        turn_rad: float = 0.0,
    ) -> None:
        x, y, yaw = self.street.place(float(along_m), float(offset_m))
        self.solids.append(Solid("box", x, y, yaw + turn_rad, length_m / 2, width_m / 2, float(low), float(high), of))

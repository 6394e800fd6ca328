"""Ranges that pixels of earlier phases suggest for those of a phase: neighbours, and surfaces through neighbours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from lidargrit.nn.pixel_phases import Phase, pixels_around, plane_weights
from lidargrit.sensors import SensorModel

_OF_PAIRS = 6  # an interpolation and two neighbours, of each of two pairs
_ONE, _OTHER = 0, 3  # numbers of the two interpolations
_NEIGHBOURS = (1, 2, 4, 5)  # numbers of the neighbours
_OF_SURFACES = 8  # four planes and four lines
_OF_GRAVITY = 8  # four upright planes and four level ones
_BEHIND = 3  # times as far as a neighbour: what lies at twice its distance may belong to the same phase
_SAME_SURFACE_V = 3e-4  # two ranges nearer than this, 6 mm at 20 m, are on one surface
_BELOW = -0.005  # height of a ray's tip over the sensor below which it may meet level ground
_ANY, _UPRIGHT, _LEVEL = slice(0, 3), slice(0, 2), slice(2, 3)  # of x, y and z: where a plane's normal may point


class Surface(NamedTuple):
    """A plane or a straight line through pixels of earlier phases, which continues to a pixel of a phase.

    Args:
        pixels: rows and columns of the lattice from the phase's pixel to those on the surface.
        normal: coordinates along which the normal of a plane may point.
        instead: number of the candidate of pairs that stands in its place where one of the pixels is missing.
    """

    pixels: tuple[tuple[int, int], ...]
    normal: slice
    instead: int


class RangeCandidates(nn.Module):
    """Ranges of a phase's pixels as its neighbours suggest them, all as v = ln(1 + range in metres).

    For each of two pairs of opposite neighbours these are an interpolation and the two ranges. With ``surfaces`` come
    the four planes through three of the neighbours, and the four straight lines through a neighbour and the pixel
    behind it; with ``gravity`` four upright planes through two pixels, and the four level ones through a neighbour. At
    an edge, surfaces are continued from either side; neighbours alone only bracket it.

    Args:
        sensor: rays of the range images.
        phases: all phases of the pixel decoder.
        surfaces: whether planes and lines are among the candidates.
        gravity: whether upright and level planes are among the candidates.
    """

    elevation_rad: Tensor

    def __init__(self, sensor: SensorModel, phases: Sequence[Phase], surfaces: bool, gravity: bool) -> None:
        super().__init__()
        self.phases, self.has_surfaces, self.has_gravity = tuple(phases), surfaces, gravity
        self.count = _OF_PAIRS + surfaces * _OF_SURFACES + gravity * _OF_GRAVITY
        self.distances = 3 + surfaces * 8 + gravity * 4
        self.column_rad = 2 * math.pi / sensor.width
        self.limits_m = (sensor.range_min_m, sensor.range_max_m)
        elevation = sensor.elevation_rad.double().mean(1).float()
        self.register_buffer("elevation_rad", elevation, persistent=False)
        self.offsets: list[tuple[tuple[int, int], ...]] = []  # of each phase, from a pixel to all that surfaces need
        for number, phase in enumerate(self.phases):
            surfaces_of = self.surfaces_of(phase)
            offsets = tuple(dict.fromkeys((*phase.neighbours, *(each for one in surfaces_of for each in one.pixels))))
            self.offsets.append(offsets)
            if surfaces_of:
                chosen, weights, instead = self._tables(phase, surfaces_of, offsets)
                self.register_buffer(f"pixels_{number}", chosen, persistent=False)
                self.register_buffer(f"weights_{number}", weights, persistent=False)
                self.register_buffer(f"instead_{number}", instead, persistent=False)

    def surfaces_of(self, phase: Phase) -> list[Surface]:
        """Return the planes and lines that are candidates of a phase, in their order."""
        near, found = phase.neighbours, []
        if self.has_surfaces:
            planes = zip(range(4), (_OTHER, _OTHER, _ONE, _ONE), strict=True)  # all of the other pair is on the plane
            found += [Surface(near[:left_out] + near[left_out + 1 :], _ANY, pair) for left_out, pair in planes]
            lines = zip(near, _NEIGHBOURS, strict=True)
            found += [Surface((one, (_BEHIND * one[0], _BEHIND * one[1])), _ANY, itself) for one, itself in lines]
        if self.has_gravity:
            if phase.corners_known:  # between a pixel on the left and one on the right, the same row first
                ends = (((-1, -1), (-1, 1)), ((1, -1), (1, 1)), ((-1, -1), (1, 1)), ((1, -1), (-1, 1)))
                upright = zip(ends, (_ONE, _OTHER, _ONE, _OTHER), strict=True)
            else:  # beyond the neighbour on the left, and beyond that on the right
                ends = [((0, side), (row, 2 * side)) for side in (-1, 1) for row in (-1, 1)]
                beside = [_NEIGHBOURS[near.index(one)] for one, _ in ends]
                upright = zip(ends, beside, strict=True)
            found += [Surface(both, _UPRIGHT, instead) for both, instead in upright]
            found += [Surface((one,), _LEVEL, itself) for one, itself in zip(near, _NEIGHBOURS, strict=True)]
        return found

    def forward(
        self, phase: Phase, v: Float[Tensor, "B H W"], known: Bool[Tensor, "B H W"], expected: Float[Tensor, "B h w"]
    ) -> Float[Tensor, "B K h w"]:
        """Return the candidates: for both pairs an interpolation and the two neighbours, then those of surfaces.

        One missing of a pair is taken to be as far as the other; where both are missing, as far as expected. In place
        of a surface through a missing pixel stands an interpolation or the neighbour.

        Args:
            phase: phase whose pixels are generated next.
            v: ln(1 + range in metres) of every pixel.
            known: True where a pixel returned.
            expected: ln(1 + range) of the phase's pixels without neighbours.
        """
        number = self.phases.index(phase)
        values, has = pixels_around(phase, v, known, self.offsets[number])
        weights = plane_weights(phase, self.elevation_rad)
        found = []
        for first, (down, _) in zip((0, 2), phase.pairs, strict=True):
            (one, other), (has_one, has_other) = (maps[:, first : first + 2].unbind(1) for maps in (values, has))
            one_or_other = torch.where(has_one, one, torch.where(has_other, other, expected))
            other_or_one = torch.where(has_other, other, torch.where(has_one, one, expected))
            weight = weights if down else torch.full_like(weights, 0.5)
            # On a plane 1 / range is linear in the sines of the angles between the rays.
            inverse = weight[..., 0] / one_or_other.expm1() + weight[..., 1] / other_or_one.expm1()
            found += [inverse.reciprocal().log1p(), one_or_other, other_or_one]
        of_pairs = torch.stack(found, 1)
        if self.count == _OF_PAIRS:
            return of_pairs
        # On a plane 1 / range is a linear function of the ray; with a pixel that is missing it is no number.
        inverse = torch.where(has, values.expm1().reciprocal(), torch.nan)
        chosen, weights, instead = (self.get_buffer(f"{name}_{number}") for name in ("pixels", "weights", "instead"))
        # Sums of products and no matrix product, which mixed precision would round to three digits.
        on_surfaces = (inverse[:, chosen] * weights).sum(2)
        low, high = self.limits_m  # what no ray of the sensor meets is as far as it measures
        limited = on_surfaces.clamp(1 / high, 1 / low).reciprocal().log1p()
        return torch.cat((of_pairs, torch.where(on_surfaces.isnan(), of_pairs[:, instead], limited)), 1)

    def apart(self, candidates: Float[Tensor, "B K h w"]) -> Float[Tensor, "B D h w"]:
        """Return how far some candidates are apart, on a logarithmic scale: where they agree there is no edge."""
        first, second, rest = candidates[:, 1:3], candidates[:, 4:6], candidates[:, _OF_PAIRS:]
        apart = [first.diff(dim=1), second.diff(dim=1), candidates[:, _ONE, None] - candidates[:, _OTHER, None]]
        if self.has_surfaces:
            (planes, lines), rest = rest[:, :_OF_SURFACES].chunk(2, 1), rest[:, _OF_SURFACES:]
            opposite = torch.cat((first.flip(1), second.flip(1)), 1)
            apart += [planes[:, ::2] - planes[:, 1::2], lines[:, ::2] - lines[:, 1::2], lines - opposite]
        if self.has_gravity:
            apart.append(rest[:, ::2] - rest[:, 1::2])
        return ((torch.cat(apart, 1).abs() + _SAME_SURFACE_V).log() + 5) / 2

    def _tables(
        self, phase: Phase, surfaces: list[Surface], offsets: tuple[tuple[int, int], ...]
    ) -> tuple[Tensor, Float[Tensor, "S 3 h 1"], Tensor]:
        """Return for each surface which pixels it goes through, their weights, and what stands in its place."""
        chosen = [[offsets.index(pixel) for pixel in surface.pixels] for surface in surfaces]
        chosen = [[*numbers, *numbers[:1] * (3 - len(numbers))] for numbers in chosen]  # the first again, of weight 0
        weights = torch.stack([self._weights(phase, surface) for surface in surfaces])[..., None]
        instead = torch.tensor([surface.instead for surface in surfaces])
        return torch.tensor(chosen), weights.to(self.elevation_rad), instead

    def _weights(self, phase: Phase, surface: Surface) -> Float[Tensor, "3 h"]:
        """Return the weights of 1 / range of a surface's pixels, NaN where the surface does not exist.

        They are those by which the rays of these pixels add up to the ray of the phase's pixel, in the coordinates
        along which the normal may point; for lines as nearly as they can, by least squares.
        """
        rays = self._rays(phase, [*surface.pixels, (0, 0)])
        exists = rays.isfinite().all(-1).all(0)
        if surface.normal == _LEVEL:
            exists &= (rays[..., 2] < _BELOW).all(0)
        through = rays[:, exists][..., surface.normal].movedim(0, -1)  # (rows, coordinates, pixels and the phase's)
        weights = rays.new_zeros(3, rays.shape[1])
        weights[:, ~exists] = torch.nan
        solved = torch.linalg.lstsq(through[..., :-1], through[..., -1:]).solution[..., 0]
        weights[: len(surface.pixels), exists] = solved.mT
        return weights

    def _rays(self, phase: Phase, offsets: list[tuple[int, int]]) -> Float[Tensor, "N h 3"]:
        """Return rays so many rows and columns of the lattice from each row of a phase, which is at azimuth 0.

        Rays beyond the image are NaN.
        """
        elevation = self.elevation_rad.double()
        rows = torch.arange(len(elevation), device=elevation.device)[phase.pixels[0]]
        found = []
        for down, right in offsets:
            row = rows + down * phase.lattice.rows
            inside = (row >= 0) & (row < len(elevation))
            up = torch.where(inside, elevation[row.clamp(0, len(elevation) - 1)], torch.nan)
            azimuth = torch.full_like(up, right * phase.lattice.columns * self.column_rad)
            found.append(torch.stack((up.cos() * azimuth.cos(), up.cos() * azimuth.sin(), up.sin()), -1))
        return torch.stack(found)

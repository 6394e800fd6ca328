"""Ranges that pixels of earlier phases suggest for those of a phase: neighbours, and surfaces through neighbours."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from lidargrit.generation.pixel_decoder.pixel_phases import Phase, pixels_around, plane_weights
from lidargrit.scans.sensors import SensorModel

_OF_PAIRS = 6  # an interpolation and two neighbours, of each of two pairs
_FIRST, _SECOND = 0, 3  # numbers of the two interpolations
_NEIGHBOURS = (1, 2, 4, 5)  # numbers of the neighbours
_OF_SURFACES = 8  # four planes and four lines
_BEHIND = 3  # times as far as a neighbour: what lies at twice its distance may belong to the same phase
_SAME_SURFACE_V = 3e-4  # two ranges nearer than this, 6 mm at 20 m, are on one surface
_SINE_TO_GROUND = -0.005  # of the elevation: rays above it do not meet the ground
_WIDEST_RAD = math.pi / 2 - 1e-6  # pixels at a right angle and more do not tell of one surface
_XYZ, _XY, _Z = (0, 1, 2), (0, 1), (2,)


class Surface(NamedTuple):
    """A plane or a straight line through pixels of earlier phases, which continues to a pixel of a phase.

    Args:
        pixels: rows and columns of the lattice from the phase's pixel to those on the surface.
        coordinates: coordinates of its normal that may differ from 0: x, y and z; x and y of a vertical plane; z of a
            horizontal one.
        fallback: number of the candidate that takes its place where one of the pixels is missing.
    """

    pixels: tuple[tuple[int, int], ...]
    coordinates: tuple[int, ...]
    fallback: int


class RangeCandidates(nn.Module):
    """Ranges of a phase's pixels as its neighbours suggest them, all as v = ln(1 + range in metres).

    For each of two pairs of opposite neighbours these are an interpolation and the two ranges. With ``surfaces`` come
    the four planes through three of the neighbours, and the four straight lines through a neighbour and the pixel
    behind it; with ``gravity`` four vertical planes through two pixels, and the horizontal ones through each neighbour,
    which in the same row are its own range. At an edge, surfaces are continued from either side; neighbours alone only
    bracket it.

    Args:
        phases: all phases of the pixel decoder.
        surfaces: whether planes and lines are among the candidates.
        gravity: whether vertical and horizontal planes are among the candidates.
    """

    elevation_rad: Tensor

    def __init__(self, sensor: SensorModel, phases: Sequence[Phase], surfaces: bool, gravity: bool) -> None:
        super().__init__()
        self.phases, self.has_surfaces, self.has_gravity = tuple(phases), surfaces, gravity
        self.column_rad = 2 * math.pi / sensor.width
        self.limits_m = (sensor.range_min_m, sensor.range_max_m)
        elevation = sensor.elevation_rad.double().mean(1).float()
        self.register_buffer("elevation_rad", elevation, persistent=False)
        self.offsets = [self._offsets(phase) for phase in self.phases]
        for number, phase in enumerate(self.phases):
            if phase.rank and (surfaces or gravity):
                for name, table in zip(("pixels", "weights", "fallback"), self._tables(phase), strict=True):
                    self.register_buffer(f"{name}_{number}", table, persistent=False)
            if phase.rank:
                self.register_buffer(f"of_rows_{number}", plane_weights(phase, elevation), persistent=False)
        self.count = _OF_PAIRS + len(self.surfaces_of(self.phases[0]))
        self.distances = self.differences(torch.zeros(1, self.count, 1, 1)).shape[1]

    def surfaces_of(self, phase: Phase) -> list[Surface]:
        """Return the planes and lines that are candidates of a phase, in their order."""
        near, found = phase.neighbours, []
        if self.has_surfaces:
            planes = zip(range(4), (_SECOND, _SECOND, _FIRST, _FIRST), strict=True)  # all of that pair is on the plane
            found += [Surface(near[:left_out] + near[left_out + 1 :], _XYZ, pair) for left_out, pair in planes]
            lines = zip(near, _NEIGHBOURS, strict=True)
            found += [Surface((one, (_BEHIND * one[0], _BEHIND * one[1])), _XYZ, itself) for one, itself in lines]
        if self.has_gravity:
            if phase.corners_known:  # between a pixel on the left and one on the right
                ends = [((-1, -1), (-1, 1)), ((1, -1), (1, 1)), ((-1, -1), (1, 1)), ((1, -1), (-1, 1))]
                fallbacks = [_FIRST, _SECOND, _FIRST, _SECOND]
            else:  # beyond the neighbour on the left, and beyond that on the right
                ends = [((0, side), (row, 2 * side)) for side in (-1, 1) for row in (-1, 1)]
                fallbacks = [_NEIGHBOURS[near.index(one)] for one, _ in ends]
            found += [Surface(both, _XY, fallback) for both, fallback in zip(ends, fallbacks, strict=True)]
            found += [Surface((one,), _Z, itself) for one, itself in zip(near, _NEIGHBOURS, strict=True)]
        return found

    def forward(
        self, phase: Phase, v: Float[Tensor, "B H W"], known: Bool[Tensor, "B H W"], expected: Float[Tensor, "B h w"]
    ) -> Float[Tensor, "B K h w"]:
        """Return the candidates: for both pairs an interpolation and the two neighbours, then those of surfaces.

        One missing of a pair is taken to be as far as the other; where both are missing, as far as expected. In place
        of a surface through a missing pixel stands an interpolation or the neighbour. The first phase has no
        neighbours, so all its candidates are as far as expected.

        Args:
            phase: phase whose pixels are generated next.
            v: ln(1 + range in metres) of every pixel.
            known: True where a pixel returned.
            expected: ln(1 + range) of the phase's pixels without neighbours.
        """
        if not phase.rank:
            return expected[:, None].expand(-1, self.count, -1, -1)
        number = self.phases.index(phase)
        values, has = pixels_around(phase, v, known, self.offsets[number])
        of_rows = self.get_buffer(f"of_rows_{number}")
        found = []
        for first, (down, _) in zip((0, 2), phase.pairs, strict=True):
            (one, other), (has_one, has_other) = (maps[:, first : first + 2].unbind(1) for maps in (values, has))
            one_or_other = torch.where(has_one, one, torch.where(has_other, other, expected))
            other_or_one = torch.where(has_other, other, torch.where(has_one, one, expected))
            weight = of_rows if down else torch.full_like(of_rows, 0.5)
            # On a plane 1 / range is linear in the sines of the angles between the rays of a column.
            inverse = weight[..., 0] / one_or_other.expm1() + weight[..., 1] / other_or_one.expm1()
            found += [inverse.reciprocal().log1p(), one_or_other, other_or_one]
        of_pairs = torch.stack(found, 1)
        if self.count == _OF_PAIRS:
            return of_pairs
        pixels, weights, fallback = (self.get_buffer(f"{name}_{number}") for name in ("pixels", "weights", "fallback"))
        # On a plane 1 / range is a linear function of the ray; with a pixel that is missing it is NaN.
        inverse = torch.where(has, values.expm1().reciprocal(), torch.nan)
        # Sums of products and no matrix product, which mixed precision would round to three digits.
        inverse_on_surfaces = (inverse[:, pixels] * weights).sum(2)
        low, high = self.limits_m  # what no ray of the sensor meets is as far as it measures
        on_surfaces = inverse_on_surfaces.clamp(1 / high, 1 / low).reciprocal().log1p()
        return torch.cat((of_pairs, torch.where(on_surfaces.isnan(), of_pairs[:, fallback], on_surfaces)), 1)

    def differences(self, candidates: Float[Tensor, "B K h w"]) -> Float[Tensor, "B D h w"]:
        """Return how far some candidates are apart, on a logarithmic scale: where they agree there is no edge."""
        first, second, rest = candidates[:, 1:3], candidates[:, 4:6], candidates[:, _OF_PAIRS:]
        apart = [first.diff(dim=1), second.diff(dim=1), candidates[:, _FIRST, None] - candidates[:, _SECOND, None]]
        if self.has_surfaces:
            (planes, lines), rest = rest[:, :_OF_SURFACES].chunk(2, 1), rest[:, _OF_SURFACES:]
            opposite = torch.cat((first.flip(1), second.flip(1)), 1)
            apart += [planes[:, ::2] - planes[:, 1::2], lines[:, ::2] - lines[:, 1::2], lines - opposite]
        if self.has_gravity:
            apart.append(rest[:, ::2] - rest[:, 1::2])
        return ((torch.cat(apart, 1).abs() + _SAME_SURFACE_V).log() + 5) / 2

    def _offsets(self, phase: Phase) -> tuple[tuple[int, int], ...]:
        """Return rows and columns from a phase's pixel to its neighbours, then to all others that surfaces need."""
        on_surfaces = [pixel for surface in self.surfaces_of(phase) for pixel in surface.pixels]
        return tuple(dict.fromkeys((*phase.neighbours, *on_surfaces)))

    def _tables(self, phase: Phase) -> tuple[Int[Tensor, "S 3"], Float[Tensor, "S 3 h 1"], Int[Tensor, " S"]]:
        """Return for each surface the numbers of its pixels, the weights of their 1 / range, and its fallback.

        The weights are those by which the rays of the pixels add up to the ray of the phase's pixel, in the coordinates
        of the normal; for lines as nearly as they can, by least squares. They are NaN where there is no surface.
        """
        surfaces, offsets = self.surfaces_of(phase), self._offsets(phase)
        rays = self._rays(phase, [*offsets, (0, 0)])
        below = rays[..., 2] < _SINE_TO_GROUND
        pixels = torch.zeros(len(surfaces), 3, dtype=torch.long, device=rays.device)
        weights = rays.new_zeros(len(surfaces), 3, rays.shape[1])
        for kind in dict.fromkeys((len(surface.pixels), surface.coordinates) for surface in surfaces):
            alike = [n for n, each in enumerate(surfaces) if (len(each.pixels), each.coordinates) == kind]
            through = torch.tensor(
                [[offsets.index(pixel) for pixel in surfaces[n].pixels] for n in alike], device=rays.device
            )
            size, coordinates = kind
            exists = rays[through].isfinite().all(-1).all(1)
            if coordinates == _Z:
                exists &= below[through].all(1) & below[-1]
            columns = rays[through][..., coordinates].permute(0, 2, 3, 1)  # (surfaces, rows, coordinates, pixels)
            full_rank = torch.eye(len(coordinates), size, dtype=rays.dtype, device=rays.device)
            columns = torch.where(exists[..., None, None], columns, full_rank)
            here = rays[-1][..., coordinates, None].expand(len(alike), -1, -1, -1)
            solved = torch.linalg.lstsq(columns, here).solution[..., 0]
            weights[alike, :size] = torch.where(exists[..., None], solved, torch.nan).mT
            pixels[alike] = through[:, [0, 1, 2][:size] + [0] * (3 - size)]  # the first again, of weight 0
        fallback = torch.tensor([surface.fallback for surface in surfaces], device=rays.device)
        return pixels, weights[..., None].to(self.elevation_rad), fallback

    def _rays(self, phase: Phase, offsets: Sequence[tuple[int, int]]) -> Float[Tensor, "N h 3"]:
        """Return rays so many rows and columns of the lattice from each row of a phase, which is at azimuth 0.

        Rays beyond the image, and those at a right angle and more, are NaN.
        """
        elevation = self.elevation_rad.double()
        rows = torch.arange(len(elevation), device=elevation.device)[phase.pixels[0]]
        found = []
        for down, right in offsets:
            row, azimuth_rad = rows + down * phase.lattice.rows, right * phase.lattice.columns * self.column_rad
            inside = (row >= 0) & (row < len(elevation)) & (abs(azimuth_rad) < _WIDEST_RAD)
            up = torch.where(inside, elevation[row.clamp(0, len(elevation) - 1)], torch.nan)
            found.append(
                torch.stack((up.cos() * math.cos(azimuth_rad), up.cos() * math.sin(azimuth_rad), up.sin()), -1)
            )
        return torch.stack(found)

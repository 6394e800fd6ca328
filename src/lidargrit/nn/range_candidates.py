"""Ranges that pixels of earlier phases suggest for those of a phase: neighbours, and surfaces through neighbours."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from lidargrit.nn.pixel_phases import Neighbours, Phase, neighbours_of, plane_weights
from lidargrit.sensors import SensorModel

_OF_PAIRS = 6  # an interpolation and two neighbours, of each of two pairs
_OF_SURFACES = 8  # four planes and four lines
_BEHIND = 3  # times as far as a neighbour: what lies at twice its distance may belong to the same phase
_WEIGHTS = ("planes", "lines", "lines_behind")  # buffers of every phase
_SAME_SURFACE_V = 3e-4  # two ranges nearer than this, 6 mm at 20 m, are on one surface


class RangeCandidates(nn.Module):
    """Ranges of a phase's pixels as its neighbours suggest them, all as v = ln(1 + range in metres).

    For each of two pairs of opposite neighbours these are an interpolation and the two ranges. With ``surfaces`` come
    the four planes through three of the neighbours, and the four straight lines through a neighbour and the pixel
    behind it. At an edge, lines continue the surface of either side; neighbours alone only bracket it.

    Args:
        sensor: rays of the range images.
        phases: all phases of the pixel decoder.
        surfaces: whether planes and lines are among the candidates.
    """

    elevation_rad: Tensor

    def __init__(self, sensor: SensorModel, phases: Sequence[Phase], surfaces: bool) -> None:
        super().__init__()
        self.phases, self.surfaces = tuple(phases), surfaces
        self.count = _OF_PAIRS + surfaces * _OF_SURFACES
        self.distances = 3 + surfaces * 8
        self.column_rad = 2 * math.pi / sensor.width
        self.limits_m = (sensor.range_min_m, sensor.range_max_m)
        elevation = sensor.elevation_rad.double().mean(1).float()
        self.register_buffer("elevation_rad", elevation, persistent=False)
        for number, phase in enumerate(self.phases if surfaces else ()):
            for name, weights in zip(_WEIGHTS, self._weights(phase), strict=True):
                self.register_buffer(f"{name}_{number}", weights, persistent=False)

    def forward(
        self, phase: Phase, v: Float[Tensor, "B H W"], known: Bool[Tensor, "B H W"], expected: Float[Tensor, "B h w"]
    ) -> Float[Tensor, "B K h w"]:
        """Return the candidates: for both pairs an interpolation and the two neighbours, then planes, then lines.

        One missing of a pair is taken to be as far as the other; where both are missing, as far as expected. In place
        of a plane or line through a missing pixel stands an interpolation or the neighbour.

        Args:
            phase: phase whose pixels are generated next.
            v: ln(1 + range in metres) of every pixel.
            known: True where a pixel returned.
            expected: ln(1 + range) of the phase's pixels without neighbours.
        """
        near = neighbours_of(phase, v, known)
        weights = plane_weights(phase, self.elevation_rad)
        found = []
        for pair, rows_apart in enumerate(near.rows_apart):
            (one, other), (has_one, has_other) = near.values[:, pair].unbind(1), near.known[:, pair].unbind(1)
            one_or_other = torch.where(has_one, one, torch.where(has_other, other, expected))
            other_or_one = torch.where(has_other, other, torch.where(has_one, one, expected))
            weight = weights if rows_apart else torch.full_like(weights, 0.5)
            # On a plane 1 / range is linear in the sines of the angles between the rays.
            inverse = weight[..., 0] / one_or_other.expm1() + weight[..., 1] / other_or_one.expm1()
            found += [inverse.reciprocal().log1p(), one_or_other, other_or_one]
        of_pairs = torch.stack(found, 1)
        if not self.surfaces:
            return of_pairs
        return torch.cat((of_pairs, *self._on_surfaces(phase, near, neighbours_of(phase, v, known, _BEHIND), found)), 1)

    def apart(self, candidates: Float[Tensor, "B K h w"]) -> Float[Tensor, "B D h w"]:
        """Return how far some candidates are apart, on a logarithmic scale: where they agree there is no edge."""
        first, second = candidates[:, 1:3], candidates[:, 4:6]
        apart = [first.diff(dim=1), second.diff(dim=1), candidates[:, :1] - candidates[:, 3:4]]
        if self.surfaces:
            planes, lines = candidates[:, _OF_PAIRS : _OF_PAIRS + 4], candidates[:, _OF_PAIRS + 4 :]
            opposite = torch.cat((first.flip(1), second.flip(1)), 1)
            apart += [planes[:, ::2] - planes[:, 1::2], lines[:, ::2] - lines[:, 1::2], lines - opposite]
        return ((torch.cat(apart, 1).abs() + _SAME_SURFACE_V).log() + 5) / 2

    def _on_surfaces(
        self, phase: Phase, near: Neighbours, behind: Neighbours, of_pairs: list[Float[Tensor, "B h w"]]
    ) -> tuple[Float[Tensor, "B 4 h w"], Float[Tensor, "B 4 h w"]]:
        """Return the four planes that leave out one neighbour each, and the line through each neighbour."""
        has, has_behind = near.known.flatten(1, 2), behind.known.flatten(1, 2)
        # On a plane 1 / range is a linear function of the ray.
        inverse, inverse_behind = (
            torch.where(which.known, which.values.expm1().reciprocal(), 0.0).flatten(1, 2) for which in (near, behind)
        )
        number = self.phases.index(phase)
        of_planes, of_line, of_line_behind = (self.get_buffer(f"{name}_{number}") for name in _WEIGHTS)
        # Sums of products and no matrix product, which mixed precision would round to three digits.
        planes = torch.stack([(weight * inverse).sum(1) for weight in of_planes], 1)
        lines = of_line * inverse + of_line_behind * inverse_behind
        first, *first_pair, second, _, _ = of_pairs
        complete = has.sum(1, keepdim=True) - has.long() == 3
        other_pair = torch.stack((second, second, first, first), 1)  # all of it is on the plane
        neighbours = torch.stack((*first_pair, *of_pairs[4:]), 1)
        return (
            torch.where(complete, self._within_limits(planes), other_pair),
            torch.where(has & has_behind, self._within_limits(lines), neighbours),
        )

    def _within_limits(self, inverse: Float[Tensor, "B K h w"]) -> Float[Tensor, "B K h w"]:
        """Return ln(1 + range) from 1 / range; what no ray of the sensor meets is as far as it measures."""
        low, high = self.limits_m
        return inverse.clamp(1 / high, 1 / low).reciprocal().log1p()

    def _weights(self, phase: Phase) -> tuple[Float[Tensor, "4 4 h 1"], Float[Tensor, "4 h 1"], Float[Tensor, "4 h 1"]]:
        """Return the weights of 1 / range: of the neighbours for each plane, of neighbours and those behind for lines.

        They are those by which the rays of these pixels add up to the ray of the phase's pixel; for lines as nearly as
        they can, by least squares. They are 0 where a pixel lies beyond the image.
        """
        offsets = [(sign * down, sign * right) for down, right in phase.pairs for sign in (1, -1)]
        here, near = self._rays(phase, [(0, 0)])[0], self._rays(phase, offsets)
        behind = self._rays(phase, [(_BEHIND * down, _BEHIND * right) for down, right in offsets])
        planes = here.new_zeros(4, 4, len(here))
        for left_out in range(4):
            three = [index for index in range(4) if index != left_out]
            whole = _volume([near[index] for index in three])
            for index in three:  # Cramer's rule
                replaced = [here if other == index else near[other] for other in three]
                planes[left_out, index] = _volume(replaced) / whole
        cosine, to_near, to_behind = ((a * b).sum(-1) for a, b in ((near, behind), (near, here), (behind, here)))
        lines = torch.stack((to_near - cosine * to_behind, to_behind - cosine * to_near)) / (1 - cosine.square())
        planes, lines = (each.nan_to_num(0.0).to(self.elevation_rad)[..., None] for each in (planes, lines))
        return planes, lines[0], lines[1]

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


def _volume(rays: list[Float[Tensor, "h 3"]]) -> Float[Tensor, " h"]:
    """Return the signed volume of the box that three vectors span."""
    one, two, three = rays
    return (one * torch.linalg.cross(two, three)).sum(-1)

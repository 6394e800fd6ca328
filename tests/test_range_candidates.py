"""Candidates of a range: surfaces through earlier pixels, against a loop over pixels."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lidargrit.nn.pixel_phases import Phase, phases_of
from lidargrit.nn.range_candidates import RangeCandidates
from lidargrit.sensors import SensorModel
from lidargrit.structures import RangeImage
from pixel_decoder_examples import random_images, tiny_sensor

ROWS, COLUMNS = 16, 64
_EXPECTED_M = 33.0
XYZ = [0, 1, 2]


def candidates_m(phase: Phase, images: RangeImage) -> np.ndarray:
    expected = torch.full_like(images.range_m, _EXPECTED_M)[(..., *phase.pixels)].log1p()
    suggest = RangeCandidates(images.sensor, [phase], surfaces=True, gravity=True)
    found = suggest(phase, images.range_m.log1p(), images.return_mask, expected)
    assert found.shape[1] == suggest.count
    assert suggest.apart(found).shape[1] == suggest.distances
    return found.expm1().numpy()


def upright_ends(phase: Phase) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Return the two pixels of every upright plane: left and right corners, or a neighbour and one beyond it."""
    if phase.rank != 1 and phase.lattice.known == "corners":
        return [((0, side), (down, 2 * side)) for side in (-1, 1) for down in (-1, 1)]
    return [((left, -1), (right, 1)) for left, right in ((-1, -1), (1, 1), (-1, 1), (1, -1))]


def instead_of_missing(phase: Phase) -> list[int]:
    """Return the number of the interpolation or neighbour that stands in for each surface."""
    beyond = phase.rank != 1 and phase.lattice.known == "corners"
    upright = [4, 4, 5, 5] if beyond else [0, 3, 0, 3]
    return [3, 3, 0, 0, 1, 2, 4, 5, *upright, 1, 2, 4, 5]


def slow_candidates_m(phase: Phase, images: RangeImage, row: int, column: int) -> list[float]:
    """Return planes and lines of one pixel by NumPy's least squares, of rays as the sensor has them.

    An upright plane is a line seen from above, and a level one has the same height everywhere.
    """
    rays = images.sensor.ray_directions().double().numpy()
    known, range_m = images.return_mask[0].numpy(), images.range_m[0].double().numpy()

    def pixel(times: int, down: int, right: int) -> tuple[int, int] | None:
        at = row + times * down * phase.lattice.rows, (column + times * right * phase.lattice.columns) % COLUMNS
        return at if 0 <= at[0] < ROWS and known[at] else None

    def surface(pixels: list[tuple[int, int] | None], coordinates: list[int]) -> float:
        through = [at for at in pixels if at is not None]
        if len(through) < len(pixels):
            return np.nan
        matrix = np.stack([rays[at][coordinates] for at in through], -1)
        weights = np.linalg.lstsq(matrix, rays[row, column][coordinates], rcond=None)[0]
        inverse = sum(weight / range_m[at] for weight, at in zip(weights, through, strict=True))
        return 1 / np.clip(inverse, 1 / images.sensor.range_max_m, 1 / images.sensor.range_min_m)

    if not phase.rank:
        return [np.nan] * 16
    offsets = [(sign * down, sign * right) for down, right in phase.pairs for sign in (1, -1)]
    near, behind = ([pixel(times, *offset) for offset in offsets] for times in (1, 3))
    found = [surface([at for index, at in enumerate(near) if index != left_out], XYZ) for left_out in range(4)]
    found += [surface([one, other], XYZ) for one, other in zip(near, behind, strict=True)]
    found += [surface([pixel(1, *a), pixel(1, *b)], XYZ[:2]) for a, b in upright_ends(phase)]
    for at in near:
        below = at is not None and max(rays[at][2], rays[row, column][2]) < -0.005
        found.append(surface([at], XYZ[2:]) if below else np.nan)
    return found


@pytest.mark.parametrize(("cell", "halvings"), [(8, (0, 0)), (4, (2, 0)), (4, (0, 2))])
def test_planes_and_lines_are_those_of_a_loop_over_pixels(cell: int, halvings: tuple[int, int]) -> None:
    images = random_images(tiny_sensor(ROWS, COLUMNS), 1)
    seen = np.zeros(16, dtype=int)
    for phase in phases_of(cell, *halvings):
        ours = candidates_m(phase, images)[0]
        for i, row in enumerate(range(ROWS)[phase.pixels[0]]):
            for j, column in enumerate(range(COLUMNS)[phase.pixels[1]]):
                slow = np.array(slow_candidates_m(phase, images, row, column))
                found = ~np.isnan(slow)
                seen += found
                np.testing.assert_allclose(ours[6:, i, j][found], slow[found], rtol=2e-3)
                pairs = ours[instead_of_missing(phase), i, j]
                np.testing.assert_array_equal(ours[6:, i, j][~found], pairs[~found])
    assert seen.min() > 80


def plane_image(sensor: SensorModel, normal: tuple[float, float, float], distance_m: float) -> RangeImage:
    """Return what a sensor sees of one plane."""
    along = (sensor.ray_directions() * torch.tensor(normal)).sum(-1)
    range_m = distance_m / along.clamp(min=1e-3)
    seen = (along > 1e-3) & (range_m < sensor.range_max_m) & (range_m > sensor.range_min_m)
    return RangeImage.masked(torch.where(seen, range_m, 1.0)[None], seen[None], sensor)


@pytest.mark.parametrize("normal", [(0.0, 0.0, -1.0), (0.6, 0.8, 0.0), (0.0, -0.96, 0.28)])
@pytest.mark.parametrize("precision", [torch.float32, torch.bfloat16])
def test_pixels_of_one_plane_suggest_it(normal: tuple[float, float, float], precision: torch.dtype) -> None:
    images = plane_image(tiny_sensor(ROWS, COLUMNS), normal, 1.7)
    counts = np.zeros(16, dtype=int)
    with torch.autocast("cpu", precision, enabled=precision != torch.float32):
        for phase in phases_of(4):
            ours, true_m = candidates_m(phase, images)[0], images.range_m[(0, *phase.pixels)].numpy()
            for i, row in enumerate(range(ROWS)[phase.pixels[0]]):
                for j, column in enumerate(range(COLUMNS)[phase.pixels[1]]):
                    found = ~np.isnan(slow_candidates_m(phase, images, row, column)) & (true_m[i, j] > 0)
                    counts += found
                    # Three pixels determine a plane, two an upright one, and one a level one.
                    exact = np.zeros(16, dtype=bool)
                    exact[:4], exact[8:12], exact[12:] = True, normal[2] == 0, abs(normal[2]) == 1
                    np.testing.assert_allclose(ours[6:, i, j][found & exact], true_m[i, j], rtol=1e-3)
    assert counts.min() > 20

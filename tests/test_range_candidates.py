"""Candidates of a range: neighbours, and surfaces through earlier pixels, against a loop over pixels."""

import math

import numpy as np
import pytest
import torch

from lidargrit.generation.pixel_decoder.pixel_phases import Phase, phases_of
from lidargrit.generation.pixel_decoder.range_candidates import RangeCandidates
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage
from pixel_decoder_examples import random_images, tiny_sensor

ROWS, COLUMNS = 16, 64
_EXPECTED_M = 33.0
XYZ = [0, 1, 2]


def candidates_m(phase: Phase, images: RangeImage, surfaces: bool = True, gravity: bool = True) -> np.ndarray:
    expected = torch.full_like(images.range_m, _EXPECTED_M)[(..., *phase.pixels)].log1p()
    candidates = RangeCandidates(images.sensor, [phase], surfaces, gravity)
    found = candidates(phase, images.range_m.log1p(), images.return_mask, expected)
    assert found.shape[1] == candidates.count
    return found.expm1().numpy()


def ends_of_vertical_planes(phase: Phase) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Return the two pixels of each: left and right corners, or a neighbour and one beyond it."""
    if phase.rank != 1 and phase.lattice.known == "corners":
        return [((0, side), (down, 2 * side)) for side in (-1, 1) for down in (-1, 1)]
    return [((left, -1), (right, 1)) for left, right in ((-1, -1), (1, 1), (-1, 1), (1, -1))]


def fallbacks(phase: Phase) -> list[int]:
    """Return the number of the interpolation or neighbour that takes the place of each surface."""
    beyond = phase.rank != 1 and phase.lattice.known == "corners"
    vertical = [4, 4, 5, 5] if beyond else [0, 3, 0, 3]
    return [3, 3, 0, 0, 1, 2, 4, 5, *vertical, 1, 2, 4, 5]


def slow_candidates_m(phase: Phase, images: RangeImage, row: int, column: int) -> list[float]:
    """Return the candidates of one pixel, NaN for surfaces that do not exist.

    Surfaces are by NumPy's least squares, of rays as the sensor has them: a vertical plane is a line seen from above,
    and a horizontal one has the same height everywhere.
    """
    rays = images.sensor.ray_directions().double().numpy()
    elevation_rad = images.sensor.elevation_rad[:, 0].tolist()
    known, range_m = images.return_mask[0].numpy(), images.range_m[0].double().numpy()

    def pixel(times: int, down: int, right: int) -> tuple[int, int] | None:
        at = row + times * down * phase.lattice.rows, (column + times * right * phase.lattice.columns) % COLUMNS
        return at if 0 <= at[0] < ROWS and known[at] else None

    def between(one: tuple[int, int] | None, other: tuple[int, int] | None, down: int) -> list[float]:
        ranges_m = [range_m[at] for at in (one, other) if at is not None] or [_EXPECTED_M]
        shares, step = (0.5, 0.5), down * phase.lattice.rows
        if down and min(row + step, row - step) >= 0 and max(row + step, row - step) < ROWS:
            first, last, here = (elevation_rad[at] for at in (row + step, row - step, row))
            shares = (math.sin(here - last) / math.sin(first - last), math.sin(first - here) / math.sin(first - last))
        return [1 / (shares[0] / ranges_m[0] + shares[1] / ranges_m[-1]), ranges_m[0], ranges_m[-1]]

    def surface(pixels: list[tuple[int, int] | None], coordinates: list[int]) -> float:
        aside = COLUMNS // 4  # pixels at a right angle and more do not tell of one surface
        columns = [(at[1] - column + COLUMNS // 2) % COLUMNS - COLUMNS // 2 for at in pixels if at is not None]
        through = [at for at, right in zip(filter(None, pixels), columns, strict=True) if abs(right) < aside]
        if len(through) < len(pixels):
            return np.nan
        matrix = np.stack([rays[at][coordinates] for at in through], -1)
        weights = np.linalg.lstsq(matrix, rays[row, column][coordinates], rcond=None)[0]
        inverse = sum(weight / range_m[at] for weight, at in zip(weights, through, strict=True))
        return 1 / np.clip(inverse, 1 / images.sensor.range_max_m, 1 / images.sensor.range_min_m)

    if not phase.rank:
        return [_EXPECTED_M] * 6 + [np.nan] * 16
    offsets = [(sign * down, sign * right) for down, right in phase.pairs for sign in (1, -1)]
    near, behind = ([pixel(times, *offset) for offset in offsets] for times in (1, 3))
    found = [*between(near[0], near[1], offsets[0][0]), *between(near[2], near[3], offsets[2][0])]
    found += [surface([at for index, at in enumerate(near) if index != left_out], XYZ) for left_out in range(4)]
    found += [surface([one, other], XYZ) for one, other in zip(near, behind, strict=True)]
    found += [surface([pixel(1, *a), pixel(1, *b)], XYZ[:2]) for a, b in ends_of_vertical_planes(phase)]
    for at in near:
        below = at is not None and max(rays[at][2], rays[row, column][2]) < -0.005
        found.append(surface([at], XYZ[2:]) if below else np.nan)
    return found


@pytest.mark.parametrize(("cell", "halvings"), [(8, (0, 0)), (4, (2, 0)), (4, (0, 2))])
def test_candidates_are_those_of_a_loop_over_pixels(cell: int, halvings: tuple[int, int]) -> None:
    images = random_images(tiny_sensor(ROWS, COLUMNS), 1)
    seen = np.zeros(22, dtype=int)
    for phase in phases_of(cell, *halvings):
        ours = candidates_m(phase, images)[0]
        for i, row in enumerate(range(ROWS)[phase.pixels[0]]):
            for j, column in enumerate(range(COLUMNS)[phase.pixels[1]]):
                slow = np.array(slow_candidates_m(phase, images, row, column))
                found = ~np.isnan(slow)
                seen += found
                np.testing.assert_allclose(ours[:, i, j][found], slow[found], rtol=2e-3)
                instead = slow[fallbacks(phase)]
                np.testing.assert_allclose(ours[6:, i, j][~found[6:]], instead[~found[6:]], rtol=1e-4)
    assert seen.min() > 80


@pytest.mark.parametrize(("surfaces", "gravity", "kept"), [(False, False, 6), (True, False, 14), (False, True, 14)])
def test_each_kind_of_surface_may_be_left_out(surfaces: bool, gravity: bool, kept: int) -> None:
    images = random_images(tiny_sensor(ROWS, COLUMNS), 1)
    for phase in phases_of(4):
        every, some = candidates_m(phase, images), candidates_m(phase, images, surfaces, gravity)
        assert some.shape[1] == kept
        np.testing.assert_array_equal(some[:, :6], every[:, :6])
        np.testing.assert_array_equal(some[:, 6:], every[:, 6:14] if surfaces else every[:, 14 : 14 + 8 * gravity])


def plane_image(sensor: SensorModel, normal: tuple[float, float, float], distance_m: float) -> RangeImage:
    """Return what a sensor sees of one plane."""
    along = (sensor.ray_directions() * torch.tensor(normal)).sum(-1)
    range_m = distance_m / along.clamp(min=1e-3)
    seen = (along > 1e-3) & (range_m < sensor.range_max_m) & (range_m > sensor.range_min_m)
    return RangeImage.masked(torch.where(seen, range_m, 1.0)[None], seen[None], sensor)


@pytest.mark.parametrize("normal", [(0.0, 0.0, -1.0), (0.6, 0.8, 0.0), (0.0, -0.96, 0.28)])
def test_pixels_of_one_plane_suggest_it(normal: tuple[float, float, float]) -> None:
    """In either precision."""
    images = plane_image(tiny_sensor(ROWS, COLUMNS), normal, 1.7)
    counts = np.zeros(16, dtype=int)
    for phase in phases_of(4):
        true_m = images.range_m[(0, *phase.pixels)].numpy()
        ours = [candidates_m(phase, images)[0]]
        with torch.autocast("cpu", torch.bfloat16):
            ours.append(candidates_m(phase, images)[0])
        for i, row in enumerate(range(ROWS)[phase.pixels[0]]):
            for j, column in enumerate(range(COLUMNS)[phase.pixels[1]]):
                found = ~np.isnan(slow_candidates_m(phase, images, row, column))[6:] & (true_m[i, j] > 0)
                counts += found
                # Three pixels determine a plane, two a vertical one, and one a horizontal one.
                exact = np.zeros(16, dtype=bool)
                exact[:4], exact[8:12], exact[12:] = True, normal[2] == 0, abs(normal[2]) == 1
                for each in ours:
                    np.testing.assert_allclose(each[6:, i, j][found & exact], true_m[i, j], rtol=1e-3)
    assert counts.min() > 20


def test_candidates_that_agree_are_told_from_those_across_an_edge() -> None:
    candidates = RangeCandidates(tiny_sensor(ROWS, COLUMNS), [phases_of(4)[1]], surfaces=True, gravity=True)
    same = torch.full((1, candidates.count, 1, 1), 2.0)
    assert torch.allclose(candidates.differences(same), torch.tensor((math.log(3e-4) + 5) / 2))
    pairs = [(1, 2), (4, 5), (0, 3), (6, 7), (8, 9), (10, 11), (12, 13), (10, 2), (11, 1), (12, 5), (13, 4)]
    pairs += [(14, 15), (16, 17), (18, 19), (20, 21)]
    v = torch.randn(1, candidates.count, 1, 1, generator=torch.Generator().manual_seed(0))
    expected = [(math.log(abs(float(v[0, a] - v[0, b])) + 3e-4) + 5) / 2 for a, b in pairs]
    np.testing.assert_allclose(candidates.differences(v).flatten().numpy(), expected, rtol=1e-5)

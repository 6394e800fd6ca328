"""Candidates of a range: planes and lines through earlier pixels, against a loop over pixels."""

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


def candidates_m(phase: Phase, images: RangeImage) -> np.ndarray:
    expected = torch.full_like(images.range_m, _EXPECTED_M)[(..., *phase.pixels)].log1p()
    suggest = RangeCandidates(images.sensor, [phase], surfaces=True)
    found = suggest(phase, images.range_m.log1p(), images.return_mask, expected)
    assert found.shape[1] == suggest.count
    assert suggest.apart(found).shape[1] == suggest.distances
    return found.expm1().numpy()


def slow_candidates_m(phase: Phase, images: RangeImage, row: int, column: int) -> list[float]:
    """Return planes and lines of one pixel by NumPy's least squares, of rays as the sensor has them."""
    rays = images.sensor.ray_directions().double().numpy()
    known, range_m = images.return_mask[0].numpy(), images.range_m[0].double().numpy()

    def pixel(times: int, down: int, right: int) -> tuple[int, int] | None:
        at = row + times * down * phase.lattice.rows, (column + times * right * phase.lattice.columns) % COLUMNS
        return at if 0 <= at[0] < ROWS and known[at] else None

    def surface(pixels: list[tuple[int, int]]) -> float:
        matrix = np.stack([rays[at] for at in pixels], -1)
        weights = np.linalg.lstsq(matrix, rays[row, column], rcond=None)[0]
        inverse = sum(weight / range_m[at] for weight, at in zip(weights, pixels, strict=True))
        return 1 / np.clip(inverse, 1 / images.sensor.range_max_m, 1 / images.sensor.range_min_m)

    offsets = [(sign * down, sign * right) for down, right in phase.pairs for sign in (1, -1)]
    near = [pixel(1, *offset) if phase.rank else None for offset in offsets]
    behind = [pixel(3, *offset) if phase.rank else None for offset in offsets]
    found = []
    for left_out in range(4):
        three = [at for index, at in enumerate(near) if index != left_out and at is not None]
        found.append(surface(three) if len(three) == 3 else np.nan)
    for one, other in zip(near, behind, strict=True):
        found.append(surface([one, other]) if one is not None and other is not None else np.nan)
    return found


@pytest.mark.parametrize(("cell", "halvings"), [(8, (0, 0)), (4, (2, 0)), (4, (0, 2))])
def test_planes_and_lines_are_those_of_a_loop_over_pixels(cell: int, halvings: tuple[int, int]) -> None:
    images = random_images(tiny_sensor(ROWS, COLUMNS), 1)
    seen = 0
    for phase in phases_of(cell, *halvings):
        ours = candidates_m(phase, images)[0]
        for i, row in enumerate(range(ROWS)[phase.pixels[0]]):
            for j, column in enumerate(range(COLUMNS)[phase.pixels[1]]):
                slow = np.array(slow_candidates_m(phase, images, row, column))
                found = ~np.isnan(slow)
                seen += int(found.sum())
                np.testing.assert_allclose(ours[6:, i, j][found], slow[found], rtol=2e-3)
                pairs = ours[[3, 3, 0, 0, 1, 2, 4, 5], i, j]  # in place of a surface with a missing pixel
                np.testing.assert_array_equal(ours[6:, i, j][~found], pairs[~found])
    assert seen > 1000


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
    counts = np.zeros(8, dtype=int)
    with torch.autocast("cpu", precision, enabled=precision != torch.float32):
        for phase in phases_of(4):
            ours, true_m = candidates_m(phase, images)[0], images.range_m[(0, *phase.pixels)].numpy()
            for i, row in enumerate(range(ROWS)[phase.pixels[0]]):
                for j, column in enumerate(range(COLUMNS)[phase.pixels[1]]):
                    found = ~np.isnan(slow_candidates_m(phase, images, row, column)) & (true_m[i, j] > 0)
                    counts += found
                    # Three rays determine a plane, two nearly do.
                    np.testing.assert_allclose(ours[6:10, i, j][found[:4]], true_m[i, j], rtol=1e-3)
    assert counts.min() > 20

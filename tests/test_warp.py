"""The past of a drive on the rays of the present: against a slow loop, turned and mirrored, and on a known wall."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from lidargrit.core.errors import ConfigError, ScanError
from lidargrit.scans.augmentation import augment
from lidargrit.scans.example import Example
from lidargrit.scans.past import Past
from lidargrit.scans.sensors import SensorModel, column_azimuths_rad
from lidargrit.scans.types import RangeImage
from lidargrit.scans.warp import WarpedReturns, warp

STRIDE = 4
SENSOR = SensorModel(
    "tiny",
    torch.tensor([0.1, 0.04, -0.02, -0.12, -0.2])[:, None],
    column_azimuths_rad(48, STRIDE),
    1.0,
    60.0,
    "spherical",
    STRIDE,
)


def moved_by(x_m: float, y_m: float, turn_rad: float) -> torch.Tensor:
    cosine, sine = math.cos(turn_rad), math.sin(turn_rad)
    return torch.tensor([[cosine, -sine, 0, x_m], [sine, cosine, 0, y_m], [0, 0, 1, 0.02], [0, 0, 0, 1]]).double()


def some_past(batch: int = 2) -> Past:
    """Return two pasts of three scans: smooth surfaces with edges and holes, and the car moves and turns."""
    rng = torch.Generator().manual_seed(3)
    range_m = 6 + 3 * torch.rand(batch, 3, 5, 12, generator=rng).repeat_interleave(4, -1)
    range_m += 0.1 * torch.rand(batch, 3, 5, 48, generator=rng)
    range_m *= torch.rand(range_m.shape, generator=rng) < 0.8
    transforms = torch.stack([moved_by(-0.6, 0.1, 0.04), moved_by(-0.4, 0.05, -0.03), moved_by(-0.2, 0.0, 0.01)])
    ages_s = torch.tensor([0.3, 0.2, 0.1]).double().expand(batch, 3)
    return Past(range_m, transforms.expand(batch, 3, 4, 4), ages_s, SENSOR)


def end_of(points: np.ndarray, lengths: np.ndarray, pixel: tuple[int, int], step: tuple[int, int]) -> np.ndarray:
    """Return the neighbour of a return on its own surface, or the return where there is none."""
    there = pixel[0] + step[0], (pixel[1] + step[1]) % 48
    if not 0 <= there[0] < 5 or lengths[there] == 0:
        return points[pixel]
    return points[there] if abs(lengths[there] - lengths[pixel]) <= 0.15 * lengths[pixel] else points[pixel]


def slow_warp(past: Past, one: int) -> dict[str, np.ndarray]:
    """Return the layers of one scan's past, return by return, by arc functions."""
    fine, kept = (sensor.ray_directions().double().numpy() for sensor in (SENSOR.fine(), SENSOR))
    elevation = SENSOR.elevation_rad[:, 0].double().numpy()
    azimuth = SENSOR.azimuth_rad[0].double().numpy()
    column_rad = 2 * math.pi / 48
    found = []
    for at in (2, 1, 0):
        points = past.range_m[one, at].double().numpy()[..., None] * fine
        lengths = np.linalg.norm(points, axis=-1)
        matrix = past.transforms[one, at].numpy()
        for row, column in zip(*np.nonzero(lengths > 0), strict=True):
            ends = [end_of(points, lengths, (row, column), step) for step in ((0, 2), (0, -2), (1, 0), (-1, 0))]
            normal = np.cross(ends[0] - ends[1], ends[2] - ends[3])
            point = matrix[:3, :3] @ points[row, column] + matrix[:3, 3]
            normal = matrix[:3, :3] @ normal / max(np.linalg.norm(normal), 1e-300)
            distance = np.linalg.norm(point)
            up = math.asin(point[2] / distance)
            to = int(np.abs(elevation - up).argmin())
            if (
                up > elevation[0] + (elevation[0] - elevation[1]) / 2
                or up < elevation[-1] - (elevation[-2] - elevation[-1]) / 2
            ):
                continue
            aside = np.abs((azimuth - math.atan2(point[1], point[0]) + math.pi) % (2 * math.pi) - math.pi)
            column_to = int(aside.argmin())
            if aside[column_to] > column_rad or not 1 <= distance <= 60:
                continue
            ray = kept[to, column_to]
            cosine = normal @ ray
            new = normal @ point / cosine if abs(cosine) >= 0.03 else distance
            new = new if abs(new - distance) <= 0.1 * distance else distance
            offset = 2 * math.asin(np.linalg.norm(point / distance - ray) / 2)
            close = aside[column_to] <= column_rad / 2
            found.append((to, column_to, new, past.ages_s[one, at].item(), abs(cosine), offset, close, at))
    layers = {name: np.zeros((4, 5, 12)) for name in ("last", "nearest", "aligned", "surface")}
    for to in range(5):
        for column in range(12):
            here = [hit for hit in found if hit[:2] == (to, column)]
            chosen = {
                "last": min((hit for hit in here if hit[7] == 2), key=lambda hit: hit[2], default=None),
                "nearest": min((hit for hit in here if hit[6]), key=lambda hit: hit[2], default=None),
                "aligned": min(here, key=lambda hit: hit[5], default=None),
            }
            for name, hit in chosen.items():
                layers[name][:, to, column] = 0 if hit is None else hit[2:6]
            if about := chosen["nearest"] or chosen["aligned"]:
                on_it = [hit[2] for hit in here if abs(hit[2] - about[2]) <= 0.05 + 0.02 * about[2]]
                spread = np.abs(np.array(on_it) - np.mean(on_it)).mean()
                layers["surface"][:3, to, column] = np.mean(on_it), spread, len(on_it)
    counts = [[len({hit[7] for hit in found if hit[:2] == (r, c) and hit[6]}) for c in range(12)] for r in range(5)]
    return {**layers, "scans": np.array(counts)}


def assert_alike(ours: WarpedReturns, others: WarpedReturns) -> None:
    for one, other in zip(ours, others, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-6)


def test_all_layers_are_those_of_a_slow_loop():
    past = some_past()
    warped = warp(past)
    for one in range(2):
        slow = slow_warp(past, one)
        for name in ("last", "nearest", "aligned"):
            layer: WarpedReturns = getattr(warped, name)
            assert int(layer.mask[one].sum()) > 20
            np.testing.assert_allclose(torch.stack([*layer], 1)[one, :3], slow[name][:3], rtol=1e-6, atol=1e-6)
            # Our offset is the chord, as long as the angle for small ones.
            np.testing.assert_allclose(layer.offset_rad[one], slow[name][3], rtol=2e-3, atol=1e-6)
        surface = torch.stack([part[one].double() for part in warped.surface])
        assert int((surface[2] > 1).sum()) > 5
        np.testing.assert_allclose(surface, slow["surface"][:3], rtol=1e-6, atol=1e-6)
        assert (warped.scans[one].numpy() == slow["scans"]).all()
    assert torch.equal(warped.copied_m, past.range_m[:, -1, :, ::STRIDE].double())


def test_a_wall_is_met_at_its_true_range_wherever_the_car_has_moved():
    """Rays of a later place meet a wall 10 m ahead of the earlier one at ranges that geometry tells."""
    sensor = SENSOR.with_columns(480, STRIDE)
    fine, ahead_m = sensor.fine().ray_directions().double()[..., 0], 10.0
    range_m = torch.where(fine > 0.5, ahead_m / fine, 0.0)[None, None].float()
    warped = warp(Past(range_m, moved_by(-2, 0, 0)[None, None], torch.tensor([[0.5]]).double(), sensor))
    seen = warped.nearest.mask[0]
    wanted_m = (ahead_m - 2) / sensor.ray_directions().double()[..., 0]
    assert int(seen.sum()) >= 50
    torch.testing.assert_close(warped.nearest.range_m[0][seen], wanted_m[seen], rtol=1e-5, atol=1e-5)
    assert warped.nearest.age_s[0][seen].unique().tolist() == [0.5]


@pytest.mark.parametrize("highest_deg", [6, 89.5])
def test_without_motion_the_past_is_the_present(highest_deg):
    past, elevation_rad = some_past(1), SENSOR.elevation_rad.clone()
    elevation_rad[0] = math.radians(highest_deg)  # as of a dome, whose upper row reaches beyond the zenith
    sensor = replace(SENSOR, elevation_rad=elevation_rad)
    latest = Past(past.range_m[:, 2:], torch.eye(4).double()[None, None], past.ages_s[:, 2:], sensor)
    returned = latest.range_m[0, 0, :, ::STRIDE] > 0
    ours_m = warp(latest).aligned.range_m[0].float()
    torch.testing.assert_close(ours_m[returned], latest.range_m[0, 0, :, ::STRIDE][returned])


@pytest.mark.parametrize("kind", ["flip", "roll"])
def test_the_past_turns_with_its_image(kind):
    """What the past tells of a changed image is what it tells of the image, changed alike."""
    past = some_past(6)
    numbered = torch.arange(1.0, 13).expand(6, 5, 12).clone()  # so that each column is known again
    example = Example(RangeImage(numbered, numbered > 0, SENSOR), past)
    changed = augment(example, (kind,), torch.Generator().manual_seed(5))
    assert isinstance(changed.condition, Past)
    assert not torch.equal(changed.images.range_m, numbered)
    before, after = warp(past), warp(changed.condition)
    column = changed.images.range_m.long() - 1
    for name in ("last", "nearest", "aligned"):
        assert_alike(getattr(after, name), WarpedReturns(*(part.gather(-1, column) for part in getattr(before, name))))
    assert torch.equal(after.scans, before.scans.gather(-1, column))


def test_scans_without_a_past_are_told_nothing():
    warped = warp(Past.cat([Past.nothing(SENSOR, 1, 3), some_past(1)]))
    assert not warped.nearest.mask[0].any()
    assert not warped.scans[0].any()
    assert warped.nearest.mask[1].any()


def test_a_past_is_checked():
    past = some_past(1)
    with pytest.raises(ConfigError, match="all fine columns"):
        Past(past.range_m[..., ::4], past.transforms, past.ages_s, SENSOR)
    with pytest.raises(ScanError, match="no rotation"):
        replace(past, transforms=2 * past.transforms)
    with pytest.raises(ScanError, match="after the present"):
        replace(past, ages_s=-past.ages_s)
    example = Example(RangeImage(torch.ones(1, 5, 12), torch.ones(1, 5, 12) > 0, SENSOR), past)
    with pytest.raises(ConfigError, match="geometric"):
        augment(example, ("geometric",), torch.Generator())

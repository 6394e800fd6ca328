"""The simulated street: the same scan from the same seed, KITTI's firing order, and drops for physical reasons."""

import numpy as np
import pytest
import torch

from lidargrit.errors import ConfigError
from lidargrit.projection import project, unproject
from lidargrit.projection.unfolding import rings_from_firing_order
from lidargrit.sensors import load_sensor
from lidargrit.simulator import simulate
from lidargrit.simulator.raycast import PAVEMENT, ROAD, SKY, Rays, cast
from lidargrit.simulator.returns import Chances, received_power, returns
from lidargrit.simulator.solids import Solid, Surface
from lidargrit.simulator.street import SENSOR_HEIGHT_M, Street, draw_street

SEEDS = range(12)


@pytest.fixture(scope="module")
def sensor():
    return load_sensor("hdl64e_kitti_odometry")


@pytest.fixture(scope="module")
def fine(sensor):
    """Return the sensor with all of its 2048 columns."""
    return sensor.with_columns(2048)


@pytest.fixture(scope="module")
def beams(fine):
    """Return, over a dozen streets, what each beam met and whether it came back; firing gaps are left out."""
    rays, seen = Rays.of_sensor(fine), []
    for seed in SEEDS:
        street_rng, beam_rng = np.random.default_rng(seed).spawn(2)
        street, chances = draw_street(street_rng), Chances.draw(beam_rng, fine.height, fine.width)
        hits = cast(street, rays, chances.free_path)
        range_m, came_back, _ = returns(street, rays, hits, chances)
        gloss = np.array([solid.surface.gloss for solid in street.solids] + [0, 0, 0])[hits.solid]
        upper = np.arange(fine.height)[:, None] < 40  # the car under the sensor hides some of the rest
        use = chances.fired & upper & (hits.solid != SKY)
        seen.append([a[use] for a in (range_m, came_back, hits.cos_incidence, hits.solid, gloss)])
    return [np.concatenate(column) for column in zip(*seen, strict=True)]


def empty_street(*solids):
    return Street(solids, 0.0, 0.0, 0.0, 0.0, 0.0, 5.0)


def test_same_seed_gives_same_bits():
    one, two = simulate(3), simulate(3)
    assert one.source == "simulated scan 3"
    for name in ("points_xyz_m", "reflectance", "ring"):
        assert torch.equal(getattr(one, name), getattr(two, name))


def test_global_randomness_is_neither_used_nor_changed():
    np.random.seed(0)  # noqa: NPY002
    torch.manual_seed(0)
    before = np.random.get_state()[1].copy(), torch.get_rng_state()  # noqa: NPY002
    simulate(1)
    assert np.array_equal(before[0], np.random.get_state()[1])  # noqa: NPY002
    assert torch.equal(before[1], torch.get_rng_state())


def test_other_seed_gives_another_street(sensor):
    one, two = (project(simulate(seed), sensor) for seed in (0, 1))
    both = one.return_mask & two.return_mask
    assert ((one.range_m - two.range_m).abs()[both] > 0.5).float().mean() > 0.2


def test_negative_seed_is_refused():
    with pytest.raises(ConfigError, match="the seed -1"):
        simulate(-1)


@pytest.mark.parametrize("seed", SEEDS)
def test_firing_order_unfolds_to_the_rings(seed):
    scan = simulate(seed)
    assert np.array_equal(rings_from_firing_order(scan.points_xyz_m.numpy()), scan.ring.numpy())
    assert scan.ring.unique().tolist() == list(range(64))


@pytest.mark.parametrize("name", ["hdl64e_kitti_odometry", "hdl64e_kitti_360"])
def test_projection_round_trip(name):
    sensor = load_sensor(name)
    sensor = sensor.with_columns(sensor.width * sensor.column_stride)
    scan = simulate(4, sensor)
    image = project(scan, sensor)
    assert int(image.return_mask.sum()) == len(scan)  # no two points share a pixel
    azimuth = torch.atan2(scan.points_xyz_m[:, 1], scan.points_xyz_m[:, 0])
    order = np.lexsort((-azimuth.numpy(), scan.ring.numpy()))  # firing order -> image order
    assert torch.allclose(unproject(image).points_xyz_m, scan.points_xyz_m[order], atol=1e-3)
    assert torch.equal(image.reflectance[image.return_mask], scan.reflectance[order])


def test_kept_columns_are_those_of_the_whole_scan(sensor, fine):
    whole, kept = simulate(5, sensor), simulate(5, sensor, kept_columns_only=True)
    image = project(whole, sensor)
    assert len(kept) == int(image.return_mask.sum())
    column = (
        (np.pi - torch.atan2(kept.points_xyz_m[:, 1], kept.points_xyz_m[:, 0]).double()) / (2 * np.pi) * 2048
    ).int()
    assert (column % 8 == 0).all()
    range_m = torch.zeros(64, 256)
    range_m[kept.ring, column // 8] = kept.points_xyz_m.norm(dim=1)
    assert torch.allclose(range_m, image.range_m, atol=1e-3)


def test_share_of_returns_is_like_kittis(fine):
    share = torch.stack([project(simulate(seed), fine).return_mask.float().mean(dim=1) for seed in SEEDS])  # (seeds, H)
    assert 0.75 < share.mean() < 0.9  # eight real scans looked at: 0.80 to 0.87
    assert (share.mean(dim=1) > 0.7).all()
    assert (share.mean(dim=1) < 0.93).all()
    assert 0.6 < share[:, :8].mean() < 0.95  # a part of the upper rows sees the sky


def test_ground_and_box_by_hand(fine):
    wall = Solid("box", 11.0, 0.0, 0.0, 1.0, 30.0, 0.0, 20.0, Surface(0.3))
    rays = Rays.of_sensor(fine)
    hits = cast(empty_street(wall), rays, np.ones((64, 2048), np.float32))
    ahead, behind = 1023, 0
    assert np.allclose(hits.way_m[:20, ahead], 10.0 / np.cos(rays.azimuth_rad[0, ahead]))
    assert np.allclose(hits.cos_incidence[:20, ahead], np.cos(rays.elevation_rad[:20, 0]), atol=1e-5)
    assert (hits.solid[:8, behind] == SKY).all()
    assert np.isinf(hits.way_m[:8, behind]).all()
    down = rays.elevation_rad[8:, 0]
    assert (hits.solid[8:, behind] == ROAD).all()
    assert np.allclose(hits.way_m[8:, behind], SENSOR_HEIGHT_M / np.tan(-down), rtol=1e-5)
    assert (hits.solid[20:, 512] == PAVEMENT).sum() > 5  # beyond the kerb, to the left


@pytest.mark.parametrize("shape", ["box", "cylinder", "ellipsoid"])
def test_hits_lie_on_the_solid(shape, fine):
    solid = Solid(shape, -6.0, 1.0, 0.7, 2.0, 1.2, 0.5, 2.5, Surface(0.3))  # behind: across the seam of the columns
    rays = Rays.of_sensor(fine)
    hits = cast(empty_street(solid), rays, np.ones((64, 2048), np.float32))
    on_it = hits.solid == 0
    assert on_it[:, 0].any()
    assert on_it[:, -1].any()
    azimuth, tangent = np.broadcast_arrays(rays.azimuth_rad, np.tan(rays.elevation_rad))
    way = np.where(on_it, hits.way_m, 0)
    x, y = way * np.cos(azimuth) + 6.0, way * np.sin(azimuth) - 1.0
    z = way * tangent + SENSOR_HEIGHT_M - 1.5
    along, across = np.cos(0.7) * x + np.sin(0.7) * y, np.cos(0.7) * y - np.sin(0.7) * x
    if shape == "box":
        edge = np.max([np.abs(along) / 2.0, np.abs(across) / 1.2, np.abs(z)], axis=0)
    elif shape == "cylinder":
        edge = np.maximum(np.hypot(x, y) / 2.0, np.abs(z))
    else:
        edge = np.sqrt((x**2 + y**2) / 4.0 + z**2)
    assert np.allclose(edge[on_it], 1.0, atol=1e-3)


def test_power_falls_with_range_and_incidence():
    def power(cos_incidence, range_m):
        return received_power(*(np.float32([v]) for v in (0.3, 0.0, cos_incidence, range_m)))[0]

    assert power(1, 80) == pytest.approx(power(1, 40) / 4, rel=0.1)  # far from the near field: 1 / range^2
    assert power(0.2, 40) == pytest.approx(power(1, 40) / 5)
    assert power(1, np.inf) == 0


def test_drops_grow_with_range_and_incidence(beams):
    range_m, came_back, cos_incidence, solid, _ = beams
    ground = solid < 0
    far = [1 - came_back[ground & (range_m > low) & (range_m <= low + 20)].mean() for low in (10, 30, 50, 70)]
    assert far[0] < 0.01
    assert far[0] <= far[1] < far[2] < far[3]
    assert far[3] > 0.5
    body = (solid >= 0) & (range_m > 10) & (range_m < 60)
    grazing, square = body & (cos_incidence < 0.1), body & (cos_incidence > 0.8)
    assert 1 - came_back[grazing].mean() > 2 * (1 - came_back[square].mean())


def test_drops_depend_on_material(beams):
    range_m, came_back, _, solid, gloss = beams
    near = (range_m < 25) & (solid >= 0)
    cars, others = near & (gloss > 0), near & (gloss == 0)
    assert 1 - came_back[cars].mean() > 4 * (1 - came_back[others].mean())


def test_dropped_beams_stand_in_patches(fine):
    beams_on_cars = 0
    neighbours, alone = [], []
    for seed in SEEDS:
        street_rng, beam_rng = np.random.default_rng(seed).spawn(2)
        street, chances = draw_street(street_rng), Chances.draw(beam_rng, 64, 2048)
        rays = Rays.of_sensor(fine)
        hits = cast(street, rays, chances.free_path)
        dropped = ~returns(street, rays, hits, chances)[1] & chances.fired
        body = np.array([s.surface.gloss > 0 and s.surface.windows == "none" for s in street.solids] + [False] * 3)
        pair = body[hits.solid[:, 1:]] & (hits.solid[:, 1:] == hits.solid[:, :-1])  # within one body
        pair &= chances.fired[:, 1:] & chances.fired[:, :-1] & (np.arange(64)[:, None] < 40)
        neighbours.append((dropped[:, 1:] & dropped[:, :-1])[pair])
        alone.append(dropped[:, 1:][pair])
        beams_on_cars += int(pair.sum())
    rate, both = np.concatenate(alone).mean(), np.concatenate(neighbours).mean()
    assert beams_on_cars > 5000
    assert 0.02 < rate < 0.7
    assert (both - rate**2) / (rate - rate**2) > 0.6  # the correlation of neighbours; coin flips have 0


def test_reflectance_is_a_share_and_differs_by_material():
    reflectance = simulate(0).reflectance
    assert float(reflectance.min()) >= 0
    assert float(reflectance.max()) <= 1
    assert float(reflectance.std()) > 0.05

"""The exact projection as mathematics: round trips, turns of the car, who wins a pixel, which scans are refused."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lidargrit.core import discovery
from lidargrit.core.errors import ConfigError, ScanError
from lidargrit.scans.projection import RangeEncoding, index_map, inspect, project, unproject
from lidargrit.scans.sensors import SensorModel, column_azimuths_rad, load_sensor
from lidargrit.scans.types import RangeImage, Scan
from lidargrit.simulator import simulate

SENSORS = discovery.names("sensors")


def random_image(sensor, seed, share=0.7):
    rng = torch.Generator().manual_seed(seed)
    size = (sensor.height, sensor.width)
    span = sensor.range_max_m - sensor.range_min_m
    range_m = torch.rand(size, generator=rng) * 1.2 * span + sensor.range_min_m - 0.1 * span
    range_m = range_m.clamp(sensor.range_min_m, sensor.range_max_m)  # many lie at the limits, as networks' do
    return RangeImage.masked(range_m, torch.rand(size, generator=rng) < share, sensor)


def scan_at(points):
    return Scan(torch.tensor(points, dtype=torch.float32))


@given(
    name=st.sampled_from(SENSORS),
    method=st.sampled_from(["spherical", "unfolding"]),
    seed=st.integers(0, 10_000),
    columns=st.integers(64, 1100),
    share=st.floats(0.05, 1.0),
)
@settings(max_examples=60, deadline=None)
def test_projecting_an_unprojected_image_gives_it_back(name, method, seed, columns, share):
    image = random_image(load_sensor(name).with_columns(columns), seed, share)
    again = project(unproject(image), image.sensor, method, partial=True)  # few returns may leave a sector empty
    assert torch.equal(again.return_mask, image.return_mask)
    assert torch.allclose(again.range_m, image.range_m, rtol=1e-5, atol=0)


@given(seed=st.integers(0, 10_000), columns=st.integers(0, 255), method=st.sampled_from(["spherical", "unfolding"]))
@settings(max_examples=25, deadline=None)
def test_turning_the_car_by_whole_columns_rolls_the_image(seed, columns, method):
    sensor = load_sensor("hdl64e_kitti_odometry").with_columns(256)
    image = random_image(sensor, seed)
    scan = unproject(image)
    angle = 2 * math.pi * columns / 256
    turn = torch.tensor([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    turned = project(Scan(scan.points_xyz_m @ turn.T, ring=scan.ring), sensor, method)
    assert torch.equal(turned.return_mask, image.return_mask.roll(-columns, -1))
    assert torch.allclose(turned.range_m, image.range_m.roll(-columns, -1), rtol=1e-5, atol=0)


def test_no_range_appears_that_was_not_there_and_the_nearest_wins():
    scan = simulate(seed=1)
    sensor = load_sensor("hdl64e_kitti_odometry")
    image = project(scan, sensor.fine())
    ranges = set(np.linalg.norm(scan.points_xyz_m.numpy(), axis=1).tolist())
    assert {float(r) for r in image.range_m[image.return_mask]} <= ranges
    kept = project(scan, sensor)
    assert torch.equal(kept.range_m, image.range_m[:, ::8])
    two = project(scan_at([[10.0, 0, 0], [5.0, 0, 0], [7.0, 0, 0]]), load_sensor("hdl64e_kitti_360"))
    assert two.range_m[two.return_mask].tolist() == [5.0]


@given(seed=st.integers(0, 10_000), name=st.sampled_from(SENSORS), ring=st.booleans())
@settings(max_examples=40, deadline=None)
def test_every_pixel_is_a_point_of_the_scan_within_the_limits(seed, name, ring):
    sensor = load_sensor(name)
    rng = np.random.default_rng(seed)
    azimuth, far = rng.uniform(-np.pi, np.pi, 2000), 10 ** rng.uniform(-1, 2.5, 2000)
    row = rng.integers(0, sensor.height, 2000)
    elevation = sensor.elevation_rad.mean(dim=1).numpy()[row] + rng.normal(0, 1e-3, 2000)
    level = far * np.cos(elevation)
    points = np.stack((level * np.cos(azimuth), level * np.sin(azimuth), far * np.sin(elevation)), 1)
    rows = torch.from_numpy(row) if ring else None
    scan = Scan(torch.from_numpy(points.astype(np.float32)), torch.from_numpy(rng.random(2000).astype("f4")), rows)
    image = project(scan, sensor, "unfolding" if ring else "spherical")
    assert 0 < int(image.return_mask.sum()) <= len(scan)
    ranges_m = np.linalg.norm(scan.points_xyz_m.numpy(), axis=1)
    for limit_m in (sensor.range_min_m, sensor.range_max_m):
        ranges_m[np.abs(ranges_m - limit_m) < 9e-7 * limit_m] = limit_m  # within what 32 bits round
    pairs = zip(ranges_m.tolist(), scan.reflectance.tolist(), strict=True)
    kept = zip(image.range_m[image.return_mask].tolist(), image.reflectance[image.return_mask].tolist(), strict=True)
    assert set(kept) <= {pair for pair in pairs if sensor.range_min_m <= pair[0] <= sensor.range_max_m}
    assert not image.reflectance[~image.return_mask].any()


def test_a_near_point_beyond_the_limits_does_not_hide_a_good_one():
    scan, sensor = scan_at([[10.0, 0, 0], [0.5, 0, 0]]), load_sensor("hdl64e_kitti_360")
    exact, reference = (
        project(scan, sensor),
        project(scan_at([[10.0, 0, 0], [0.5, 0, 0], [5, 5, 0]]), sensor, variant="reference"),
    )
    assert exact.range_m[exact.return_mask].tolist() == [10.0]
    assert 10.0 not in reference.range_m  # the released program loses it


def test_rows_and_columns_are_where_the_conventions_say():
    sensor = load_sensor("hdl64e_kitti_360")
    for (x, y), column in (((-1, 1e-3), 0), ((0, 1), 256), ((1, 0), 512), ((0, -1), 768), ((-1, -1e-3), 1023)):
        image = project(scan_at([[10.0 * x, 10.0 * y, 0]]), sensor)
        assert image.return_mask.nonzero()[0, 1] == column
    high, low = (project(scan_at([[10.0, 0, z]]), sensor).return_mask.nonzero()[0, 0] for z in (0.5, -4.5))
    assert (int(high), int(low)) == (0, 62)


@pytest.mark.parametrize("kind", [torch.int8, torch.int16, torch.int32, torch.int64])
def test_labels_may_have_any_number_of_bits(kind):
    sensor, instance = load_sensor("hdl64e_kitti_360"), 0 if kind.itemsize < 4 else 7 << 16
    scan = Scan(torch.tensor([[10.0, 0, 0], [0, 10.0, 0]]), label=torch.tensor([40 + instance, 50], dtype=kind))
    label = project(scan, sensor).label
    assert label[label > 0].tolist() == [50, 40]  # the left comes first
    assert label.dtype == torch.int64


@pytest.mark.parametrize("name", SENSORS)
def test_rays_are_unit_vectors_and_rows_descend(name):
    sensor = load_sensor(name)
    assert torch.allclose(sensor.ray_directions().norm(dim=-1), torch.ones(sensor.height, sensor.width), atol=1e-6)
    assert bool((sensor.elevation_rad.diff(dim=0) < 0).all())
    assert bool((sensor.azimuth_rad.diff(dim=1) < 0).all())
    assert SensorModel.from_json(sensor.to_json()).same_rays(sensor)
    assert not sensor.with_columns(128).same_rays(sensor)


@pytest.mark.parametrize("kind", ["linear", "log", "inverse"])
@given(seed=st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_encodings_are_monotone_round_trips_onto_the_interval(kind, seed):
    encoding = RangeEncoding(kind, 0.9, 120.0)
    range_m = torch.rand(64, generator=torch.Generator().manual_seed(seed)).sort().values * 119.1 + 0.9
    encoded = encoding.encode(range_m, torch.ones(64, dtype=torch.bool))
    assert bool((encoded.diff() >= 0).all())
    assert float(encoded.min()) >= -1
    assert float(encoded.max()) <= 1 + 1e-6
    assert torch.allclose(encoding.decode(encoded), range_m, rtol=1e-3)
    assert encoding.encode(range_m, torch.zeros(64, dtype=torch.bool)).unique().tolist() == [-1.0]


def test_a_sensor_that_does_not_fit_is_told_with_those_that_would():
    elevation = np.radians(np.linspace(60, 30, 16)).repeat(100)
    azimuth = np.tile(np.linspace(-3, 3, 100), 16)
    points = 10 * np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], 1
    )
    scan = Scan(torch.from_numpy(points.astype(np.float32)))
    with pytest.raises(ScanError, match=r"outside the sensor's elevations .* lie above 30.0 degrees"):
        project(scan, load_sensor("hdl64e_kitti_360"))
    with pytest.raises(ScanError, match=r"\d+ rings"):
        project(scan, load_sensor("hdl64e_kitti_odometry"))
    velodyne = simulate(seed=0, sensor=load_sensor("hdl64e_kitti_360").with_columns(200))
    with pytest.raises(ScanError, match=r"with --sensor \(hdl64e_kitti_360 or hdl64e_kitti_odometry, or find"):
        project(velodyne, load_sensor("vlp16"), "spherical")


def test_images_that_contradict_themselves_are_refused():
    sensor = load_sensor("hdl64e_kitti_360").with_columns(4)
    good = torch.full((64, 4), 5.0)
    with pytest.raises(ScanError, match="256 pixels whose range contradicts"):
        RangeImage(good, torch.zeros_like(good, dtype=torch.bool), sensor)
    with pytest.raises(ConfigError, match="64x3; wanted the 64x4"):
        RangeImage(good[:, :3], good[:, :3] > 0, sensor)
    with pytest.raises(ScanError, match="one by one"):
        unproject(RangeImage.stack([RangeImage(good, good > 0, sensor)]))


@pytest.mark.usefixtures("untyped")
@pytest.mark.parametrize("use", [project, index_map, inspect])
def test_a_word_that_names_no_projection_is_refused(use):
    scan, sensor = scan_at([[10.0, 0, 0], [0, 10.0, 0]]), load_sensor("vlp16")
    with pytest.raises(ConfigError, match="got variant='exat'; wanted exact, reference or clamped; correct it"):
        use(scan, sensor, variant="exat")
    with pytest.raises(ConfigError, match="got method='sphericl'; wanted spherical or unfolding; correct it"):
        use(scan, sensor, "sphericl")


def test_points_of_64_bits_are_those_of_32():
    """NumPy's own floats have 64 bits, and comparing them with rounded ones would find no nearest point."""
    scan, sensor = simulate(seed=5), load_sensor("hdl64e_kitti_odometry")
    wide = Scan(scan.points_xyz_m.double(), scan.reflectance.double(), scan.ring)
    ours, theirs = project(wide, sensor), project(scan, sensor)
    assert torch.equal(ours.range_m, theirs.range_m)
    assert torch.equal(ours.reflectance, theirs.reflectance)
    assert ours.return_mask.float().mean() > 0.5


def test_a_sensor_of_one_row_is_projected_by_ring():
    one = SensorModel("flat", torch.zeros(1, 1), column_azimuths_rad(360), 1.0, 50.0, "unfolding")
    azimuth = one.azimuth_rad[0]
    tilt = 0.001 * torch.sin(7 * azimuth)
    points = torch.stack([10 * azimuth.cos(), 10 * azimuth.sin(), 10 * tilt.tan()], dim=1)
    scan = Scan(points, ring=torch.zeros(360, dtype=torch.int64))
    assert int(project(scan, one).return_mask.sum()) == 360
    raised = Scan(points + torch.tensor([0.0, 0.0, 3.0]), ring=scan.ring)
    with pytest.raises(ScanError, match="lie elsewhere"):
        project(raised, one)


@pytest.mark.parametrize("variant", ["exact", "reference"])
def test_a_scan_beyond_the_limits_is_refused_by_both_variants(variant):
    """As of a file in millimetres: its image would be empty."""
    scan = simulate(seed=1)
    far = Scan(scan.points_xyz_m * 1000)
    with pytest.raises(ScanError, match=r"no point between 0\.9 and 120 m in .*in metres|check the unit: divide mill"):
        project(far, load_sensor("hdl64e_kitti_odometry"), variant=variant)

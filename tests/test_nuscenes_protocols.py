"""nuScenes at 32x1024: the published protocol against a loop over points, and the fair one, a row for each laser."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import lidargrit
from lidargrit.data import formats
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources.sample_formats import load_sample_format, read_tensor_folder
from lidargrit.evaluation.evaluate import EvalConfig, evaluate_sources
from lidargrit.evaluation.intervals import Resampling
from lidargrit.evaluation.pairs import grid_of_points_m
from lidargrit.evaluation.protocols import load_protocol
from lidargrit.generation.presets import load_preset
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import Scan

ROWS, COLUMNS, AZIMUTHS = 32, 1024, 200
LASERS_DEG = [32 / 3 - 4 / 3 * laser for laser in range(ROWS)]


def street(seed, tilt_deg=0.0):
    """A scan of an HDL-32E: (n, 3) points laser by laser, and the laser of each."""
    rng = np.random.default_rng(seed)
    range_m = rng.uniform(2, 75, (ROWS, AZIMUTHS))
    elevation = np.radians(LASERS_DEG)[:, None] + math.radians(tilt_deg)
    azimuth = np.linspace(-math.pi, math.pi, AZIMUTHS, endpoint=False)[None] + 1e-3
    flat = range_m * np.cos(elevation)
    xyz = np.stack((flat * np.cos(azimuth), flat * np.sin(azimuth), range_m * np.sin(elevation)), axis=-1)
    return xyz.reshape(-1, 3).astype(np.float32), np.repeat(np.arange(ROWS), AZIMUTHS)


def pixels_of_the_program(xyz):
    """Nearest range of each pixel by the formulas of load_points_as_images, which puts what lies beyond the field into
    the outer rows, and looks at the limits last."""
    found = {}
    for x, y, z in xyz.astype(np.float64):
        range_m = math.sqrt(x * x + y * y + z * z)
        row = math.floor((1 - (math.asin(z / (range_m + 1e-6)) + math.radians(30)) / math.radians(40)) * ROWS)
        column = math.floor(((-math.atan2(y, x) / math.pi + 1) / 2 % 1) * COLUMNS)
        pixel = min(max(row, 0), ROWS - 1), column
        found[pixel] = min(range_m, found.get(pixel, math.inf))
    return {pixel: range_m for pixel, range_m in found.items() if 1.45 <= range_m <= 80}


def cells(pixels):
    """Counts of the protocol's bird's-eye view: 100x100 cells of 1.6 m, points 3 to 70 m and returns within 63 m."""
    counts = np.zeros((100, 100))
    for (row, column), range_m in pixels.items():
        elevation, azimuth = math.radians(10 - 1.25 * (row + 0.5)), math.pi - 2 * math.pi * (column + 0.5) / COLUMNS
        if 3 < range_m < 63:
            flat = range_m * math.cos(elevation)
            at = [math.floor((flat * turn(azimuth) + 80) / 1.6) for turn in (math.cos, math.sin)]
            counts[at[0], at[1]] += 1
    return counts


def divergence_root(first, second):
    p, q = first.ravel() / first.sum(), second.ravel() / second.sum()
    total = 0.0
    for a, b in zip(p, q, strict=True):
        total += sum(x * math.log(2 * x / (a + b)) / 2 for x in (a, b) if x > 0)
    return math.sqrt(total)


def test_the_published_protocol_against_a_loop_over_points():
    clouds = [street(seed, -0.05)[0] for seed in range(4)]
    pixels = [pixels_of_the_program(cloud) for cloud in clouds]
    assert {row for one in pixels for row, _ in one} == set(range(ROWS)) - {7, 23}, "lasers at 0 and -20 degrees"
    raised = pixels_of_the_program(street(0, 0.05)[0])
    assert {row for row, _ in raised} == set(range(ROWS)) - {8, 24}, "the same, a little higher"
    sensor, protocol = load_sensor("hdl32e_nuscenes"), load_protocol("lidarcrafter")
    image = lidargrit.project(clouds[0], sensor, variant=protocol.variant)
    ours = {(int(row), int(column)): float(image.range_m[row, column]) for row, column in image.return_mask.nonzero()}
    assert ours == pytest.approx(pixels[0], rel=1e-6)
    sums = [sum(map(cells, some)) for some in (pixels[:2], pixels[2:])]
    card = lidargrit.evaluate(clouds[:2], clouds[2:], "lidarcrafter", ["bev_jsd"], sensor=sensor)
    assert card.scores[0].result.value == pytest.approx(divergence_root(*sums), rel=1e-6)
    assert "lidarcrafter and its source: a fault of the program, kept: it compares with scans of the" in card.as_table()
    assert protocol.splits[0] == "train"


def test_of_clouds_the_first_26000_points_alone_are_scored(tmp_path):
    rng = np.random.default_rng(0)
    for name in ("samples", "real"):
        (tmp_path / name).mkdir()
        for number in range(2):
            cloud = np.concatenate([street(int(seed), -0.05)[0] for seed in rng.integers(0, 99, 5)])  # 32,000 points
            np.save(tmp_path / name / f"{number}.npy", cloud)
    read = {name: [np.load(tmp_path / name / f"{number}.npy") for number in range(2)] for name in ("samples", "real")}
    # as fix_points_num does; the program pads shorter clouds with points at the sensor, which no cell counts
    sums = [
        sum(cells(pixels_of_the_program(cloud[:most])) for cloud in read[name])
        for name, most in (("samples", 26000), ("real", None))
    ]
    settings = EvalConfig("lidarcrafter", ("bev_jsd",), resampling=Resampling(halves=0), data=DataConfig(workers=1))
    sets = [str(tmp_path / name) for name in ("samples", "real")]
    wanted = divergence_root(*sums)
    card, _ = evaluate_sources(*sets, settings)
    assert any("the first 26,000 points alone" in warning for warning in card.warnings)
    assert "both have scans of" in evaluate_sources(sets[0], sets[0], settings)[0].leak
    assert card.scores[0].result.value == pytest.approx(wanted, abs=2e-4), "prepared ranges are rounded to 2 mm"
    in_memory = lidargrit.evaluate(
        read["samples"], read["real"], "lidarcrafter", ["bev_jsd"], sensor=load_sensor("hdl32e_nuscenes")
    )
    assert in_memory.scores[0].result.value == pytest.approx(wanted, rel=1e-6)
    whole = sum(cells(pixels_of_the_program(cloud)) for cloud in read["samples"])
    assert abs(divergence_root(whole, sums[1]) - wanted) > 0.01, "the cut changes the score"


def test_the_fair_protocol_has_a_row_for_each_laser():
    xyz, laser = street(0)
    sensor = load_protocol("fair-nuscenes").load_sensor()
    assert sensor is not None
    assert sensor.same_rays(load_preset("r2dm_nuscenes").data.load_sensor())
    assert (sensor.height, sensor.width, sensor.projection) == (ROWS, COLUMNS, "unfolding")
    image = lidargrit.project(Scan(torch.from_numpy(xyz), ring=torch.from_numpy(laser)), sensor)
    assert image.return_mask.sum(dim=1).tolist() == [AZIMUTHS] * ROWS
    np.testing.assert_allclose(np.degrees(sensor.elevation_rad[:, 0].numpy()), LASERS_DEG, atol=1e-4)


def test_samples_of_lidarcrafter_are_read(tmp_path):
    written = torch.rand(5, ROWS, COLUMNS) * 50
    written[4] /= 50
    torch.save(written, tmp_path / "samples_0000000_token.pth")
    images = read_tensor_folder(tmp_path)
    assert images.sensor.name == "hdl32e_nuscenes"
    assert torch.equal(images.batch([0]).range_m[0], written[0])
    assert "LiDARCrafter" in load_sample_format("r2dm").title


def corners_of_opendwm(cloud):
    """Points as OpenDWM's voxels2points and postprocess_points write them, in the sensor's frame (x right), float32."""
    turn = Rotation.from_euler("zyx", (-89.9, 0.6, -0.3), degrees=True).as_matrix()  # like the sensor's on the car
    low, cell = np.array([-50.0, -50, -3]), np.array([0.15625, 0.15625, 0.125])
    in_car = cloud @ turn.T + (0.94, 0, 1.84)
    voxels = np.unique(np.floor((in_car - low) / cell), axis=0)
    corners = voxels[np.all((voxels >= 0) & (voxels < (640, 640, 64)), axis=1)] * cell + low
    return ((corners - (0.94, 0, 1.84)) @ turn).astype(np.float32)


def ground_and_walls(seed):
    """A cloud in nuScenes' axes, dense enough for neighbouring voxels; the right half has a wall at 12 m, x right."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack((*rng.uniform(-40, 40, (2, 20000)), np.full(20000, -1.8)))
    wall = np.column_stack((np.full(20000, 12.0), rng.uniform(-30, 30, 20000), rng.uniform(-1.8, 2, 20000)))
    return np.concatenate((ground, wall))


def test_samples_of_opendwm_are_turned_have_no_rings_and_are_told_to_be_voxels(tmp_path):
    folder = tmp_path / "nuscenes" / "pred_voxel_samples" / "LIDAR_TOP"
    kitti = (
        tmp_path / "kitti_360" / "pred_voxel_data_3d_raw" / "2013_05_28_drive_0000_sync" / "velodyne_points" / "data"
    )
    clouds = [corners_of_opendwm(ground_and_walls(number)) for number in range(2)]
    for number, corners in enumerate(clouds):
        padded = np.concatenate([corners, np.zeros((len(corners), 2), np.float32)], axis=-1)
        for where, name in ((folder, f"n015__LIDAR_TOP__{number}.pcd.bin"), (kitti, f"{number:010}.bin")):
            where.mkdir(parents=True, exist_ok=True)
            padded.tofile(where / name)
    corners = clouds[1]
    near = np.linalg.norm(corners, axis=1) >= 1
    read = formats.read_scan(folder / "n015__LIDAR_TOP__1.pcd.bin")
    assert read.ring is None
    np.testing.assert_array_equal(read.points_xyz_m, (corners @ [[0, -1, 0], [1, 0, 0], [0, 0, 1]])[near])
    as_kitti = formats.read_scan(kitti / "0000000001.bin")
    np.testing.assert_array_equal(as_kitti.points_xyz_m, corners)
    assert as_kitti.reflectance is None
    assert grid_of_points_m(read.points_xyz_m) == pytest.approx(0.125)
    settings = EvalConfig("fair_nuscenes", ("bev_jsd",), resampling=Resampling(halves=0), data=DataConfig(workers=1))
    for number in range(2):
        (tmp_path / "real").mkdir(exist_ok=True)
        xyz, laser = street(number)
        rows = np.column_stack((-xyz[:, 1], xyz[:, 0], xyz[:, 2], np.ones(len(xyz)), 31 - laser))
        rows.astype(np.float32).tofile(tmp_path / "real" / f"{number}.pcd.bin")
    card, _ = evaluate_sources(str(tmp_path / "nuscenes"), str(tmp_path / "real"), settings)
    assert sum("lie on a grid of 0.125 m: voxels, not" in warning for warning in card.warnings) == 1
    assert card.samples.projection.startswith("spherical")
    assert card.reference.projection.startswith("spherical"), "both by elevation, since one has no rings"


def test_centres_of_voxels_are_told_beside_the_score(tmp_path):
    cloud = street(1)[0]
    voxels = np.unique((np.floor(cloud / 0.2) + 0.5).astype(np.float32) * np.float32(0.2), axis=0)
    assert grid_of_points_m(torch.from_numpy(voxels)) == pytest.approx(0.2)
    assert grid_of_points_m(torch.from_numpy(cloud)) == 0
    assert grid_of_points_m(torch.from_numpy(cloud.round(3))) == 0, "text with millimetres"
    for name, points in (("voxels", voxels), ("clouds", cloud)):
        (tmp_path / name).mkdir()
        for number in range(2):
            np.savez(tmp_path / name / f"{number}.npz", points)
    settings = EvalConfig("lidarcrafter", ("bev_jsd",), resampling=Resampling(halves=0), data=DataConfig(workers=1))
    told = evaluate_sources(str(tmp_path / "voxels"), str(tmp_path / "clouds"), settings)[0].warnings
    assert sum("lie on a grid of 0.2 m: voxels, not" in warning for warning in told) == 1
    same = evaluate_sources(str(tmp_path / "clouds"), str(tmp_path / "clouds"), settings)[0].warnings
    assert not any("voxels, not" in warning for warning in same)

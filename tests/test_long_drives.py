"""Long drives: the road goes on, alike all along and clear of our car; short drives stay as they were."""

import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest

from lidargrit.core.errors import ConfigError
from lidargrit.data.drives import DriveConfig
from lidargrit.scans import classes
from lidargrit.scans.sensors import load_sensor
from lidargrit.simulator import FRAME_S, _road, frames_before_end, observe, poses_of, simulate
from lidargrit.simulator.scene.long_road import LongRoad
from lidargrit.simulator.scene.stretches import EXTENT_M, LENGTH_M
from lidargrit.simulator.tracing import Tracer, objects_in_reach
from whole_streets import mesh_of_objects, street_of

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(256)
# Points, mean range and reflectance, mean class of frames of drives of 100 m or less, in streets of version 3 and 4.
BEFORE = {
    (0, "mixed", 0, False): (14221, 18.6177, 0.23359, 64.607),
    (0, "mixed", 5, True): (14198, 18.3457, 0.23763, 64.465),
    (0, "mixed", 60, False): (13736, 18.0493, 0.24628, 63.416),
    (1, "city", 0, False): (14436, 14.4078, 0.24915, 43.497),
    (1, "city", 200, True): (13773, 15.1146, 0.23183, 43.640),
    (1, "suburb", 5, True): (14843, 12.5744, 0.29865, 51.247),
    (1, "suburb", 136, False): (14798, 12.5445, 0.29855, 52.467),
    (3, "country", 0, False): (14340, 17.9581, 0.25927, 62.946),
    (3, "country", 52, True): (14022, 16.6652, 0.25918, 61.874),
    (4, "mixed", 70, False): (13952, 16.9212, 0.26654, 62.060),
    (5, "suburb", 0, False): (14826, 12.0460, 0.26579, 45.555),
    (5, "suburb", 125, True): (14464, 12.2615, 0.27130, 45.245),
}
DRIVES = ((1, "city"), (5, "suburb"), (4, "country"))
FRAMES = 100_000


def scan_of(seed, theme, frame, **options):
    return simulate(seed, SENSOR, theme=theme, frame=frame, kept_columns_only=True, **options)


def seconds_to(seed, theme, way_m):
    return way_m / street_of(seed, theme).speed_m_s


def same_points(one, two):
    return all(
        np.array_equal(getattr(one, name), getattr(two, name)) for name in ("points_xyz_m", "reflectance", "label")
    )


def boxes_around(scene, objects, pose, low, high):
    """Return the classes of what reaches into a box of the sensor's frame, by the bounds of its triangles."""
    near = mesh_of_objects(objects_in_reach(objects, [pose], range_max_m=5.0))
    to_sensor, found = np.linalg.inv(pose), set()
    for mesh in (scene.standing, near):
        close = np.abs(mesh.triangles_m[:, 0] - pose[:3, 3]).max(axis=1) < 30
        local = mesh.triangles_m[close] @ to_sensor[:3, :3].T + to_sensor[:3, 3]
        inside = ~((local.max(axis=1) < low) | (local.min(axis=1) > high)).any(axis=1)
        found |= set(mesh.label[close][inside].tolist())
    return found


@pytest.mark.parametrize("key", BEFORE, ids=str)
def test_frames_of_short_drives_stay_as_they_were(key):
    seed, theme, frame, motion = key
    points, range_m, reflectance, label = BEFORE[key]
    scan = scan_of(seed, theme, frame, motion=motion, frames=frame + 1)
    assert len(scan) == pytest.approx(points, abs=3)  # other processors round otherwise
    assert float(scan.points_xyz_m.double().norm(dim=1).mean()) == pytest.approx(range_m, abs=5e-3)
    assert float(scan.reflectance.double().mean()) == pytest.approx(reflectance, abs=3e-4)
    assert float((scan.label & 0xFFFF).double().mean()) == pytest.approx(label, abs=2e-2)


def test_a_frame_does_not_depend_on_those_before_nor_on_the_process():
    seed, theme = DRIVES[1]
    there = seconds_to(seed, theme, 700) / FRAME_S
    frame = int(there)
    _road.cache_clear()
    straight = scan_of(seed, theme, frame)
    _road.cache_clear()
    for way_m in (0, 130, 400, 1000):  # through other stretches, and back again
        scan_of(seed, theme, int(seconds_to(seed, theme, way_m) / FRAME_S), frames=FRAMES)
    assert same_points(straight, scan_of(seed, theme, frame, frames=FRAMES))
    ask = f"""
from lidargrit.scans.sensors import load_sensor
from lidargrit.simulator import simulate
sensor = load_sensor("hdl64e_kitti_odometry").with_columns(256)
scan = simulate({seed}, sensor, theme={theme!r}, frame={frame}, kept_columns_only=True)
print(len(scan), scan.points_xyz_m.double().sum().item(), scan.label.sum().item())
"""
    found = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, check=True).stdout.split()
    sums = straight.points_xyz_m.double().sum().item(), straight.label.sum().item()
    assert found == [str(len(straight)), *(str(value) for value in sums)]


def test_returns_stay_level():
    seed, theme = DRIVES[1]
    ways_m = (100, 150, 341, 9000)
    counts = [
        len(scan_of(seed, theme, int(seconds_to(seed, theme, way_m) / FRAME_S), frames=FRAMES)) for way_m in ways_m
    ]
    assert min(counts) > 0.85 * len(scan_of(seed, theme, 0))
    assert max(counts) < 1.15 * len(scan_of(seed, theme, 0))


@pytest.mark.parametrize(("seed", "theme"), DRIVES)
def test_nothing_is_in_our_way(seed, theme):
    """Neither what stands, along both seams of a stretch, nor who comes towards us."""
    road, low, high = LongRoad(seed, theme), np.array([-2.3, -0.95, -1.15]), np.array([2.3, 0.95, 0.3])
    speed_m_s = street_of(seed, theme).speed_m_s
    for way_m in (*range(100, 150, 8), *range(325, 357, 8), 1200):
        time_s = way_m / speed_m_s
        scene = road.scene_at(time_s)
        assert not boxes_around(scene, scene.objects(time_s), scene.sensor_pose(time_s), low, high), way_m


@pytest.mark.parametrize(("seed", "theme"), DRIVES)
@pytest.mark.parametrize("way_m", [EXTENT_M, EXTENT_M + LENGTH_M, EXTENT_M + 2 * LENGTH_M])
def test_the_same_is_seen_before_and_after_another_stretch_is_near(seed, theme, way_m):
    """Rays from one place and at one time meet the same in both scenes: nothing appears, and no coordinate jumps."""
    road = LongRoad(seed, theme)
    time_s = way_m / street_of(seed, theme).speed_m_s
    before, after = road.scene_at(time_s - 1e-6), road.scene_at(time_s + 1e-6)
    assert before is not after
    turn, rise = (a.ravel() for a in np.meshgrid(np.linspace(-np.pi, np.pi, 360), np.linspace(-0.4, 0.03, 24)))
    rays = np.stack((np.cos(turn) * np.cos(rise), np.sin(turn) * np.cos(rise), np.sin(rise)), axis=1)
    found = []
    for scene in (before, after):
        pose = scene.sensor_pose(time_s)
        found.append(scene.in_drive(pose))
        origin = np.broadcast_to(pose[:3, 3], rays.shape).astype(np.float32)
        tracer = Tracer(scene.standing, 120.0, objects_in_reach(scene.objects(time_s), [pose], 120.0))
        found.append(tracer.cast(origin, (rays @ pose[:3, :3].T).astype(np.float32)).range_m)
    assert np.abs(found[0] - found[2]).max() < 1e-3
    first, second = (np.where(np.isinf(range_m), 0, range_m) for range_m in found[1::2])
    assert (first > 0).mean() > 0.7
    assert (np.abs(first - second) > 0.05).mean() < 0.005  # edges and ground at a grazing angle


@pytest.mark.parametrize(("seed", "theme"), DRIVES)
def test_the_ground_has_no_gap_where_stretches_meet(seed, theme):
    road = LongRoad(seed, theme)
    speed_m_s = street_of(seed, theme).speed_m_s
    u, v = (a.ravel() for a in np.meshgrid(np.linspace(-1.5, 1.5, 30), np.linspace(-40, 40, 81)))
    for number in (1, 2):  # the stretch that begins there
        begins_m = EXTENT_M + LENGTH_M * (number - 1)
        scene = road.scene_at((begins_m + 1) / speed_m_s)
        start = scene.plan.ground_points(u - LENGTH_M / 2, v) + np.array([0, 0, 1.5])
        down = np.broadcast_to(np.array([0, 0, -1], np.float32), start.shape)
        found = Tracer(scene.standing).cast(start.astype(np.float32), down)
        assert (found.range_m < 2.0).mean() > 0.999
        way_m = np.hypot(*(road.poses_at([begins_m / speed_m_s], 0.0)[0] - np.eye(4))[:2, 3])
        assert 0.3 * begins_m < way_m < 1.01 * begins_m


def test_poses_are_those_of_the_scans_and_our_car_keeps_its_speed():
    seed, theme = DRIVES[0]
    frames = [int(seconds_to(seed, theme, way_m) / FRAME_S) for way_m in (3, 124, 126, 700)]
    way = poses_of(seed, [FRAME_S * frame for frame in range(frames[-1] + 1)], SENSOR, theme)
    for frame in frames:
        seen = observe(seed, SENSOR, theme=theme, frame=frame, frames=FRAMES, kept_columns_only=True)
        assert np.array_equal(seen.sensor_pose, way[frame])
    step_m = np.linalg.norm(np.diff([pose[:3, 3] for pose in way], axis=0), axis=1)
    assert step_m == pytest.approx(FRAME_S * street_of(seed, theme).speed_m_s, rel=0.12)  # bends are shorter inside
    turned = [np.linalg.norm(one[:3, :3] - two[:3, :3]) for one, two in pairwise(way)]
    assert max(turned) < 0.1


def test_short_drives_end_and_long_ones_see_what_lies_ahead():
    seed, theme = DRIVES[0]
    last = frames_before_end(seed, theme) - 1
    scene = street_of(seed, theme)
    assert 99 < scene.speed_m_s * FRAME_S * (last + 1) + 1 > 100 >= scene.speed_m_s * FRAME_S * last
    short, as_short, long = (scan_of(seed, theme, last, frames=frames) for frames in (1, last + 1, last + 2))
    assert same_points(short, as_short)
    ahead = [(scan.points_xyz_m[:, 0] > 30).sum() for scan in (short, long)]
    assert ahead[1] > ahead[0] + 20
    begins = [scan_of(seed, theme, 0, frames=frames).points_xyz_m for frames in (1, FRAMES)]
    assert len(begins[0]) == pytest.approx(len(begins[1]), rel=0.01)
    parked = next(seed for seed in range(40) if street_of(seed).speed_m_s == 0)
    assert frames_before_end(parked) == FRAMES
    with pytest.raises(ConfigError, match="the frame 100000; wanted a frame from 0 to 99999"):
        scan_of(seed, theme, 0, frames=FRAMES + 1)
    with pytest.raises(ConfigError, match="frames=100001"):
        DriveConfig(SENSOR, frames=FRAMES + 1)


def test_each_object_of_a_long_drive_has_a_number_and_a_class():
    road = LongRoad(1, "city")
    things = (classes.CAR, classes.MOVING_CAR, classes.PERSON, classes.MOVING_PERSON, classes.BICYCLE)
    for time_s in (90.0, 4000.0):
        finish = road.scene_at(time_s).objects(time_s).finish()
        number = finish.instance[finish.instance > 0]
        assert len(np.unique(number)) > 60
        pairs = np.unique(np.stack((number, finish.label[finish.instance > 0])), axis=1)
        assert len(np.unique(pairs[0])) == pairs.shape[1]  # one class to a number
        assert number.max() <= 0xFFFF
        assert (finish.instance[np.isin(finish.label, things)] > 0).all()

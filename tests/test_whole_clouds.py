"""Whole clouds through complete, upsample and raydrop: nothing measured is lost, and filled points are told."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from clouds_of_streets import DENSE, SIXTEEN, is_kept, network, street
from lidargrit.data.formats import read_scan
from lidargrit.inference.complete import open_model
from lidargrit.inference.complete.cloud import _smoothed
from lidargrit.inference.complete.grid import RayGrid, columns_fired
from lidargrit.inference.complete.patterns import Pattern
from lidargrit.inference.complete.sparse import SparseReader
from lidargrit.inference.complete.tasks import AddRows, Drop, Fill, complete_scan
from lidargrit.scans.fills import EDGE, along_rows
from lidargrit.scans.projection import unproject
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage, Scan
from lidargrit.systems.completion.system import Completion
from lidargrit.systems.raydrop.system import Raydrop

# The rays of a cloud.


def test_every_column_of_a_cloud_is_in_one_image_of_the_model_and_comes_back():
    grid = RayGrid.fitting(DENSE, 128)
    assert (grid.phases, grid.sensor.width) == (4, 128)
    image = street(grid.sensor)
    images = grid.images(image)
    assert images.range_m.shape == (4, 64, 32)
    for column in range(128):
        assert torch.equal(images.range_m[column % 4][:, column // 4], image.range_m[:, column])
    back = grid.joined(images)
    assert torch.equal(back.range_m, image.range_m)
    assert torch.equal(back.reflectance, image.reflectance)
    assert len(set(grid.seeds(7, 3))) == 4


@pytest.mark.parametrize(("columns", "phases"), [(0, 4), (127, 4), (100, 3), (33, 1), (5, 1), (10**6, 32)])
def test_a_grid_has_about_as_many_columns_as_the_cloud(columns, phases):
    assert RayGrid.fitting(DENSE, columns).phases == phases


def test_columns_are_counted_from_steps_of_azimuth_with_drops_and_two_returns_of_a_ray():
    scan = unproject(street(DENSE.fine()))
    twice = replace(
        scan, **{name: torch.cat([getattr(scan, name)] * 2) for name in ("points_xyz_m", "reflectance", "ring")}
    )
    assert columns_fired(scan)[0] == columns_fired(twice)[0] == 128
    assert columns_fired(scan)[1] == pytest.approx(math.pi, abs=1e-5), "each point lies in the middle of a column"
    few = Scan(scan.points_xyz_m[:10], ring=scan.ring[:10])
    assert columns_fired(few) == (0, None)


def test_firings_on_borders_of_columns_are_put_in_their_middle():
    """A simulator that fires at whole multiples of a column, as CARLA and Ouster do, fills every pixel."""
    beside = replace(DENSE.fine(), azimuth_rad=DENSE.fine().azimuth_rad + math.pi / 128)
    full = RangeImage.masked(torch.full((64, 128), 9.0), torch.ones(64, 128, dtype=torch.bool), beside)
    seen = Drop().see(unproject(full), network(Raydrop))
    assert bool(seen.image.return_mask.all())


@pytest.mark.parametrize("wanted", ["os1_64", "os1_128", "pandar64", "hdl64e_kitti_360"])
def test_no_column_is_thrown_away_for_lying_half_a_column_off(wanted):
    """Ouster's columns have their middles where those of a VLP-16 have borders: every nearest match was a tie."""
    dense, own = load_sensor(wanted), load_sensor("vlp16")
    full = RangeImage.masked(torch.full((16, own.width), 9.0), torch.ones(16, own.width).bool(), own)
    seen = SparseReader(dense, source=own).read(unproject(full))
    rows = int(seen.on_grid.any(1).sum())
    assert int((seen.point_of_pixel >= 0).sum()) == int(seen.on_grid.sum()) == rows * dense.width


def test_firings_lie_in_the_middle_of_the_columns_of_their_cloud():
    dense, own = load_sensor("os1_64"), load_sensor("vlp16").with_columns(1024)  # whose middles are Ouster's borders
    scan = unproject(RangeImage.masked(torch.full((16, 1024), 9.0), torch.ones(16, 1024).bool(), own))
    seen = AddRows(own).see(scan, open_model("nearest", sensor=dense))
    assert int((seen.point_of_pixel >= 0).sum()) == int(seen.on_grid.any(1).sum()) * 1024


def test_fewer_columns_are_matched_as_a_slow_loop_does():
    dense, own = load_sensor("os1_64"), load_sensor("vlp16").with_columns(500)
    found = SparseReader(dense, source=own)._columns().tolist()
    wanted_rad, own_rad = (one.azimuth_rad[0].double().tolist() for one in (dense, own))
    width = 2 * math.pi / dense.width
    for column, azimuth_rad in enumerate(wanted_rad):
        inside = [
            at for at, one in enumerate(own_rad) if abs(math.remainder(one - azimuth_rad, 2 * math.pi)) < width * 0.4999
        ]
        assert (found[column] in inside) if inside else True
    taken = [one for one in found if one >= 0]
    assert sorted(taken) == list(range(500)), "each is taken once"


# One scan.


@pytest.mark.parametrize("model", ["triangulation", "network"])
def test_complete_keeps_every_point_and_fills_rays_without_one(model):
    scan = unproject(street(DENSE.fine()))
    scan = replace(scan, reflectance=scan.reflectance, ring=scan.ring)
    chosen = open_model("triangulation", sensor=DENSE.fine()) if model == "triangulation" else network(Completion)
    done = complete_scan(scan, chosen, seed=3)
    whole = done.whole()
    assert bool(done.kept.all())
    assert is_kept(scan, whole, done.kept)
    assert whole.filled.tolist() == [False] * len(scan) + [True] * len(done.filled)
    assert len(done.filled) > 100
    rays = done.filled.points_xyz_m / done.filled.points_xyz_m.norm(dim=1, keepdim=True)
    of_grid = DENSE.fine().ray_directions()
    missing = of_grid[~street(DENSE.fine()).return_mask]
    apart = torch.cdist(rays.double(), missing.double()).min(1).values
    assert float(apart.max()) < 1e-5, "on rays on which no point was measured"


def test_the_first_image_of_a_cloud_is_what_the_model_makes_of_it_alone():
    model, fine = network(Completion), street(DENSE.fine())
    grid = RayGrid.fitting(DENSE, 128)
    task = Fill(Pattern("rows:4"))
    seen = task.see(unproject(fine), model)
    alone = RangeImage(fine.range_m[:, ::4], fine.return_mask[:, ::4], DENSE, {"reflectance": fine.reflectance[:, ::4]})
    condition = task.condition(seen, 0)
    found, wanted = condition.images.range_m[0], alone.range_m * condition.return_observed[0]
    assert torch.allclose(found, wanted, rtol=1e-6)
    assert grid.seeds(5)[0] == RayGrid(DENSE, DENSE).seeds(5)[0]


def test_what_a_pattern_hides_is_left_out_and_filled():
    scan = unproject(street(DENSE.fine()))
    done = complete_scan(scan, network(Completion), Fill(Pattern("rows:4")))
    assert torch.equal(done.kept, scan.ring % 4 == 2)
    assert not bool((done.filled.ring % 4 == 2).any())


def test_points_without_a_pixel_and_two_in_one_stay():
    scan = unproject(street(DENSE.fine()))
    sky = torch.tensor([[5.0, 1, 9], [0.2, 0.1, 0.01], [300, 0, -3]])  # above all rows, too near, too far
    beside = scan.points_xyz_m[:2] * 1.5  # in the pixel of another
    points = torch.cat((scan.points_xyz_m, sky, beside))
    more = Scan(points[torch.randperm(len(points), generator=torch.Generator().manual_seed(0))])
    done = complete_scan(more, open_model("nearest", sensor=DENSE.fine()))
    assert torch.equal(done.whole().points_xyz_m[: len(more)], more.points_xyz_m)
    too_far = done.filled.points_xyz_m / done.filled.points_xyz_m.norm(dim=1, keepdim=True)
    assert float((too_far @ (sky[2] / sky[2].norm())).max()) < math.cos(0.01), "a ray with a point gets no other"


def test_ten_points_come_back():
    scan = unproject(street(DENSE.fine()))
    ten = Scan(scan.points_xyz_m[::700][:10], scan.reflectance[::700][:10], scan.ring[::700][:10])
    for model in (network(Completion), open_model("triangulation", sensor=DENSE.fine())):
        whole = complete_scan(ten, model).whole()
        assert torch.equal(whole.points_xyz_m[:10], ten.points_xyz_m)


def test_each_dropped_point_follows_its_pixel_or_the_nearest_ray():
    model, fine = network(Raydrop), street(DENSE.fine())
    scan = unproject(fine)
    outside = torch.tensor([[6.0, 1, 4], [3, -5, 4.5], [0.3, 0.2, 0.0], [190, 30, -4]])
    scan = Scan(torch.cat((scan.points_xyz_m, outside, scan.points_xyz_m[:3] * 1.2)))
    scan = Scan(scan.points_xyz_m[torch.randperm(len(scan), generator=torch.Generator().manual_seed(1))])
    task = Drop()
    seen = task.see(scan, model)
    condition = task.condition(seen, 0)
    images = model.complete(condition, seen.rays.seeds(0))
    done = task.result(seen, condition, images)
    assert 0 < int(done.kept.sum()) < len(scan)
    returned = torch.zeros(64, 128, dtype=torch.bool)
    for phase in range(4):
        returned[:, phase::4] = images.return_mask[phase]
    rows, columns = np.nonzero(seen.image.return_mask.numpy())
    rays = seen.image.sensor.ray_directions().double().numpy()[rows, columns]
    for point in range(len(scan)):
        row, column = int(seen.pixels.row[point]), int(seen.pixels.column[point])
        if not (0 <= row < 64 and bool(seen.image.return_mask[row, column])):
            xyz = scan.points_xyz_m[point].double().numpy()
            nearest = int((rays @ (xyz / np.linalg.norm(xyz))).argmax())
            row, column = rows[nearest], columns[nearest]
        assert bool(done.kept[point]) == bool(returned[row, column])


def test_drops_of_neighbouring_columns_hang_together_at_the_same_rate():
    model, scan = network(Raydrop), unproject(street(DENSE.fine()))
    seen = Drop().see(scan, model)
    condition, seeds = Drop().condition(seen, 0), seen.rays.seeds(0)
    alone = model.complete(condition, seeds).return_mask
    together = model.complete(seen.rays.beside_one_another(condition, seeds), seeds).return_mask
    assert torch.equal(alone[0], together[0]), "the first image is what the model makes of it alone"
    surface = condition.range_observed
    both = surface[1:] & surface[:-1]

    def shared(mask):  # the share of surfaces whose drop is that of the column before
        return float((mask[1:] == mask[:-1])[both].float().mean())

    assert shared(together) > shared(alone) + 0.05
    assert float(together[surface].float().mean()) == pytest.approx(float(alone[surface].float().mean()), abs=0.03)
    assert torch.equal(
        complete_scan(scan, model, Drop(), 0).kept,
        Drop().result(seen, condition, model.complete(seen.rays.beside_one_another(condition, seeds), seeds)).kept,
    )


def test_upsample_keeps_every_point_and_adds_rows_between():
    scan = unproject(street(SIXTEEN))
    dense = load_sensor("pandar64").with_columns(128)
    done = complete_scan(scan, open_model("triangulation", sensor=dense), AddRows(SIXTEEN))
    whole = done.whole()
    assert bool(done.kept.all())
    assert is_kept(scan, whole, done.kept)
    x, y, z = done.filled.points_xyz_m.T
    assert len((torch.atan2(z, torch.hypot(x, y)) * 1e3).round().unique()) > 30
    own = SIXTEEN.elevation_rad[:, 0]
    nearest = (torch.atan2(z, torch.hypot(x, y))[:, None] - own).abs().argmin(1)
    assert float((done.filled.ring == nearest).float().mean()) > 0.95, "the laser that looks most nearly as high"
    elevation_rad = torch.atan2(z, torch.hypot(x, y))
    between = (elevation_rad > own[-1]) & (elevation_rad < own[-4])  # rows that see the ground
    assert float((z[between] + 1.7).abs().median()) < 0.1


# Ranges between columns.


def test_ranges_between_returns_of_a_row_are_those_of_a_slow_loop_and_never_across_a_jump():
    rng = np.random.default_rng(0)
    azimuth_rad = math.pi - 2 * math.pi * (np.arange(24) + 0.5) / 24
    range_m = np.where(rng.random((3, 24)) < 0.5, rng.choice([5.0, 6.0, 30.0], (3, 24)), 0.0)
    at_most = 3.5 * 2 * math.pi / 24
    found = along_rows(range_m, azimuth_rad, at_most)
    for row in range(3):
        for column in range(24):
            if range_m[row, column]:
                assert found[row, column] == pytest.approx(range_m[row, column])
                continue
            left = next(step for step in range(1, 25) if range_m[row, (column - step) % 24])
            right = next(step for step in range(1, 25) if range_m[row, (column + step) % 24])
            first, second = range_m[row, (column - left) % 24], range_m[row, (column + right) % 24]
            one_surface = abs(math.log1p(first) - math.log1p(second)) <= EDGE
            share = left / (left + right)
            wanted = 1 / ((1 - share) / first + share / second) if one_surface and left + right <= 3 else 0
            assert found[row, column] == pytest.approx(wanted)


def test_the_median_over_columns_is_that_of_numpy():
    rng = np.random.default_rng(1)
    range_m = np.where(rng.random((4, 30)) < 0.7, 2 + 9 * rng.random((4, 30)), 0)
    known = rng.random((4, 30)) < 0.3
    found = _smoothed(range_m, known, 2)
    for row in range(4):
        for column in range(30):
            there = [(column + step) % 30 for step in range(-2, 3)]
            values = [range_m[row, at] for at in there if range_m[row, at] > 0 and not known[row, at]]
            own = range_m[row, column]
            wanted = np.median(values) if own > 0 and not known[row, column] else own
            assert found[row, column] == pytest.approx(wanted)


# Real scans of eight sensors.

REAL = {
    "HDL-64E, KITTI": ("kitti_odometry/sequences/00/velodyne/000000.bin", "complete", ""),
    "HDL-64E, KITTI-360": ("kitti_360/data_3d_raw/*/velodyne_points/data/0000000000.bin", "complete", ""),
    "VLP-16": ("other_sensors/vlp16_like/000000.pcd", "upsample", "vlp16"),
    "VLP-16, nebula": ("other_sensors/nebula/vlp16/*.pcd", "upsample", "vlp16"),
    "HDL-32E, nuScenes": ("other_sensors/nuscenes_hdl32e/n015*.pcd.bin", "upsample", "hdl32e"),
    "VLP-32C, Argoverse 2": ("other_sensors/argoverse2_2xvlp32c/*.feather", "upsample", "vlp32c"),
    "OS1-128, Ouster": ("other_sensors/ouster/*.pcap", "complete", "os1_128"),
    "Pandar64, nebula": ("other_sensors/nebula/64/*.pcd", "complete", "pandar64"),
}


@pytest.mark.shared
@pytest.mark.parametrize("name", REAL)
def test_real_clouds_come_back_whole(name, real):
    """As many points as came in, bit for bit, before those that were filled; raydrop gives some of them."""
    pattern, verb, sensor = REAL[name]
    scan = read_scan(next(iter(sorted(real.glob(pattern)))))
    own = load_sensor(sensor or "hdl64e_kitti_odometry").fine()
    dense = load_sensor("os1_64") if verb == "upsample" else own
    task = AddRows(own) if verb == "upsample" else Fill(Pattern("returns"))
    done = complete_scan(scan, open_model("triangulation", sensor=dense), task)
    whole = done.whole()
    assert bool(done.kept.all())
    assert is_kept(scan, whole, done.kept)
    assert len(done.filled) > 0
    if verb == "complete" and not sensor:
        dropped = complete_scan(scan, open_model("pretrained", "surfaces", device="cpu"), Drop())
        assert 0.5 * len(scan) < int(dropped.kept.sum()) < len(scan)

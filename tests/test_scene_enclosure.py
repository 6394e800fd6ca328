"""What ends the view in a street: bends, streets across, houses and woods behind; and wide roads with more lanes."""

import numpy as np
import pytest

from lidargrit.scans import classes
from lidargrit.simulator.mesh import Mesh
from lidargrit.simulator.scene.clutter import clutter
from lidargrit.simulator.scene.greenery import greenery
from lidargrit.simulator.scene.layout import driving, parked
from lidargrit.simulator.scene.plan_sampling import sample_street_plan
from lidargrit.simulator.scene.plants import THICKETS, thicket_shape
from lidargrit.simulator.scene.roads import add_ground
from lidargrit.simulator.scene.settlement import from_road_m, lay_out_houses
from lidargrit.simulator.scene.shapes import MeshBuilder
from lidargrit.simulator.tracing import Tracer

SEEDS = range(60)


def plans(theme, of=lambda plan: True, seeds=SEEDS):
    """Return plans that have something, each with its generator."""
    found = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        plan = sample_street_plan(rng, theme)
        if of(plan):
            found.append((plan, rng))
    return found


def ends(plan):
    return np.isfinite(plan.ends_m).any()


def world(plan, u, v):
    return plan.ground_points(np.asarray(u, float), np.asarray(v, float))[..., :2]


def test_distance_from_the_road_is_that_to_its_nearest_point():
    plan, rng = plans("city")[3]
    u, v = rng.uniform(-100, 100, 40), rng.uniform(-100, 100, 40)
    along = np.linspace(-125, 125, 2501)
    road = world(plan, along, 0 * along)
    for point, away in zip(world(plan, u, v), from_road_m(plan, u, v), strict=True):
        nearest = min(np.hypot(*(point - place)) for place in road)
        assert nearest - 1e-6 <= away <= np.hypot(nearest, 3.2) + 0.2  # the road's points are 6 m apart


@pytest.mark.parametrize("theme", ["city", "suburb"])
def test_no_house_behind_the_rows_stands_on_the_road_where_it_turns_back(theme):
    turns = 0
    for plan, rng in plans(theme, seeds=range(25)):
        houses = lay_out_houses(rng, plan).houses
        along = np.linspace(max(plan.ends_m[0], -110.0), min(plan.ends_m[1], 110.0), 441)
        road = world(plan, along, 0 * along)
        turn = abs(np.diff(np.unwrap(np.arctan2(*np.diff(road, axis=0).T[::-1]))).sum())
        turns = max(turns, turn)
        for house in range(len(houses.length_m)):
            yaw, apart = houses.poses.yaw_rad[house], road - houses.poses.xyz_m[house, :2]
            x = np.cos(yaw) * apart[:, 0] + np.sin(yaw) * apart[:, 1]
            y = np.cos(yaw) * apart[:, 1] - np.sin(yaw) * apart[:, 0]
            inside = (np.abs(x) < houses.length_m[house] / 2) & (np.abs(y) < houses.depth_m[house] / 2)
            assert not inside.any(), (turn, house)
    assert turns > 1.5  # more than a right angle


def test_a_road_that_ends_ends_at_a_street_across_and_at_houses():
    found = plans("suburb", ends)
    assert 0.25 * len(SEEDS) < len(found) < 0.75 * len(SEEDS)
    for plan, rng in found[:8]:
        town = lay_out_houses(rng, plan)
        for end, way in zip(plan.ends_m, (-1, 1), strict=True):
            if not np.isfinite(end):
                continue
            assert 42 < way * end < 68
            assert any(set(s.sides) == {-1, 1} and abs(s.u_m - end) < 8 for s in plan.side_streets)
            across = np.linspace(-plan.edge_m[0], plan.edge_m[1], 21)
            far, v = (a.ravel() for a in np.meshgrid(np.arange(1.0, 25.0), across))
            behind = town.covers(end + way * far, v, 0.0).reshape(21, -1)
            assert behind.any(axis=1).mean() > 0.6  # most lines of sight along the road meet a house
            assert not town.covers(np.full(21, end - way * 1.0), across, 0.0).any()


def test_nothing_of_our_road_lies_beyond_its_end():
    for plan, rng in plans("city", ends)[:6]:
        builder = MeshBuilder()
        add_ground(builder, rng, plan)
        mesh = builder.build()
        beyond = [way * (end + way * 12.0) for end, way in zip(plan.ends_m, (-1, 1), strict=True)]
        asphalt = mesh.triangles_m[np.isin(mesh.label, (classes.ROAD, classes.PARKING))].mean(axis=1)[:, :2]
        for far, way in zip(beyond, (-1, 1), strict=True):
            if np.isfinite(far):
                along = way * np.arange(far, 118, 2.0)
                away = np.linalg.norm(world(plan, along, 0 * along)[:, None] - asphalt, axis=2)
                clear = plan.in_side_street(along, 0.1 + 0 * along, 8.0) < 0
                assert (away[clear].min(axis=1) > 3.0).mean() > 0.9
        town = lay_out_houses(rng, plan)
        for placements in (parked(rng, plan, town), driving(rng, plan, plan.speed_m_s)):
            beside_ours = (np.abs(placements.v_m) < plan.farthest_front_m - 1) & ~placements.across
            assert plan.goes_on(placements.u_m[beside_ours]).all()


def test_nobody_drives_at_the_end_of_the_road_in_sight():
    for plan, rng in plans("city", lambda plan: np.isfinite(plan.ends_m[0])):
        moving = driving(rng, plan, plan.speed_m_s)
        towards = moving.select(~moving.across & (np.cos(moving.turn_rad) < 0) & (moving.speed_m_s > 0))
        for time_s in np.arange(0.0, 20.0, 0.5):
            there = towards.positions_at(time_s)[0] < plan.ends_m[0]
            away = plan.speed_m_s * time_s - plan.ends_m[0]
            assert not there.any() or away > 75


def test_side_streets_that_end_have_a_house_across_and_no_cars_beyond():
    seen = 0
    for plan, rng in plans("suburb", seeds=range(20)):
        town = lay_out_houses(rng, plan)
        cars = parked(rng, plan, town)
        for street in plan.side_streets:
            for side in street.sides if np.isfinite(street.end_m) else ():
                seen += 1
                assert street.end_m > plan.farthest_front_m + 14
                assert plan.in_side_street(street.u_m, side * (street.end_m - 1)) > 0
                others = [s for s in plan.side_streets if s is not street]
                if all(abs(s.u_m - street.u_m) > 20 for s in others):
                    assert plan.in_side_street(street.u_m, side * (street.end_m + 1)) < 0
                assert town.covers(np.array([street.u_m]), np.array([side * (street.end_m + 6.0)]), 0.0).all()
                own = (np.abs(cars.u_m - street.u_m) < street.half_m) & (cars.v_m * side > 0) & cars.across
                assert (np.abs(cars.v_m[own]) < street.end_m - 3).all()
    assert seen > 15


@pytest.mark.parametrize("variant", range(THICKETS))
def test_a_thicket_hides_most_of_what_is_behind_it(variant):
    shape = thicket_shape(variant)
    assert shape is thicket_shape(variant)
    low, high = shape.box_m
    assert -1.0 < low[2] < 0.3
    assert 5.0 < high[2] < 12.0
    assert 15.0 < high[0] - low[0] < 18.0
    x, z = (a.ravel().astype(np.float32) for a in np.meshgrid(np.linspace(-7, 7, 60), np.linspace(0.3, 3.5, 20)))
    origin = np.stack((x, np.full_like(x, -30.0), z), axis=1)
    ahead = np.tile(np.array([[0, 1, 0]], np.float32), (len(x), 1))
    hits = Tracer(Mesh.of(shape.triangles_m, 0, 0.3, classes.VEGETATION)).cast(origin, ahead)
    assert np.isfinite(hits.range_m).mean() > 0.9


def test_thickets_keep_off_roads_and_houses():
    for plan, rng in plans("suburb", seeds=range(12)):
        town = lay_out_houses(rng, plan)
        woods = greenery(rng, plan, town)[-1].placements
        assert (from_road_m(plan, woods.u_m, woods.v_m) > plan.farthest_front_m + 9).all()
        assert (plan.in_side_street(woods.u_m, woods.v_m) < 0).all()
        assert not town.covers(woods.u_m, woods.v_m, 3.0).any()


def test_cars_fill_the_lanes_of_wide_roads_and_the_squares_before_houses():
    wide = plans("city", lambda plan: plan.outer_lanes(-1) > 0, range(200))
    assert 15 < len(wide) < 80
    for plan, rng in wide[:20]:
        outer = -plan.lane_m * (plan.lanes / 2 + 0.5 + np.arange(plan.outer_lanes(-1)))
        assert outer[-1] - plan.lane_m / 2 > plan.edge(-1) - 1e-9
        going = driving(rng, plan, plan.speed_m_s)
        there = ~going.across & (np.abs(going.v_m[:, None] - outer) < 0.5).any(axis=1)
        assert there.any()
        assert (np.abs(going.u_m[there]) > 7).all()
        assert (going.speed_m_s[there] == plan.speed_m_s).all()
        for v in outer:
            own = np.sort(going.u_m[there & (np.abs(going.v_m - v) < 0.5)])
            assert (np.diff(own) > 8.9).all()
    squares = plans("suburb", lambda plan: plan.court_m(1) > 0, range(300))
    assert len(squares) > 8
    full = 0
    for plan, rng in squares:
        town = lay_out_houses(rng, plan)
        cars = parked(rng, plan, town)
        court = (cars.v_m > plan.edge_m[1] + plan.pavement_m[1] + 0.5) & (cars.v_m < plan.front(1) - 1.5) & cars.across
        full += court.sum() > 4
    assert full > 0.6 * len(squares)


def test_what_fills_pavements_is_clear_of_roads_and_ends_with_them():
    rows = 0
    for plan, rng in plans("city"):
        batch = clutter(rng, plan)
        place = batch.placements
        u, side = place.u_m, (place.v_m > 0).astype(int)
        kerb = np.array(plan.edge_m)[side]
        front = np.array([-plan.front(-1), plan.front(1)])[side]
        assert (np.abs(place.v_m) > kerb).all()
        assert (np.abs(place.v_m) < np.maximum(front, kerb + np.array(plan.pavement_m)[side])).all()
        assert (plan.in_side_street(u, place.v_m) < 0).all()
        assert plan.goes_on(u).all()
        lengths = [np.ptp(shape.triangles_m[..., 0]) for shape in batch.shapes]
        rows += sum(length > 3.5 for length in lengths)  # pieces of hoardings, scaffolds and railings, or long beds
    assert rows > len(SEEDS)
    counts = {theme: np.mean([len(clutter(rng, plan).placements) for plan, rng in plans(theme)])
              for theme in ("city", "suburb", "country")}  # fmt: skip
    assert counts["country"] == 0 < 4 * counts["suburb"] < counts["city"], counts

"""One contract for every sensor, and sensor files that strangers write: read whole, or refused in one line."""

import json
import math
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lidargrit.core import discovery
from lidargrit.core.errors import ConfigError, LidarGritError
from lidargrit.scans.projection import project, unproject
from lidargrit.scans.sensors import SensorModel, column_azimuths_rad, continuous_azimuths_rad, load_sensor
from lidargrit.scans.types import RangeImage, Scan

NAMES = discovery.names("sensors")
SIZES = {  # rows and columns, top and bottom row in degrees, from the makers' tables
    "hdl32e": (32, 1084, 10.67, -30.67),
    "hdl32e_nuscenes": (32, 1024, 9.375, -29.375),
    "hdl64e_kitti_360": (64, 1024, 2.78125, -24.78125),
    "hdl64e_kitti_odometry": (64, 256, 2.60, -23.64),
    "os1_128": (128, 1024, 20.95, -21.82),
    "os1_64": (64, 1024, 16.611, -16.611),
    "pandar64": (64, 1800, 14.882, -24.897),
    "vlp16": (16, 1800, 15.0, -15.0),
    "vlp32c": (32, 1800, 15.0, -25.0),
}


@pytest.fixture(params=NAMES)
def sensor(request) -> SensorModel:
    return load_sensor(request.param)


def small() -> SensorModel:
    """Return a sensor of three rows and eight columns."""
    return SensorModel(
        "small", torch.tensor([[0.1], [0.0], [-0.2]]), column_azimuths_rad(8), 1.0, 50.0, "spherical",
        azimuth_offset_rad=torch.tensor([0.02, 0.0, -0.02]),
    )  # fmt: skip


def test_every_sensor_has_the_size_of_its_table(sensor):
    rows, columns, top, bottom = SIZES[sensor.name]
    assert (sensor.height, sensor.width) == (rows, columns)
    ends = sensor.elevation_rad[[0, -1]].rad2deg().flatten().tolist()
    assert ends == pytest.approx([top, bottom], abs=0.005)


def test_rays_are_unit_vectors_and_fall_from_row_to_row(sensor):
    rays = sensor.ray_directions().double()
    assert rays.shape == (sensor.height, sensor.width, 3)
    assert torch.allclose(rays.norm(dim=-1), torch.ones(sensor.height, sensor.width, dtype=torch.float64), atol=1e-6)
    assert bool((rays[..., 2].diff(dim=0) < 0).all())


def test_azimuths_lie_on_the_circle_and_fall(sensor):
    azimuth = sensor.azimuth_rad
    assert bool(((azimuth > -math.pi) & (azimuth <= math.pi)).all())
    assert bool((azimuth.diff(dim=1) < 0).all())
    assert sensor.name in NAMES
    assert len(sensor.source) > 20


def test_limits_are_in_order_and_offsets_are_small_and_one_a_row(sensor):
    assert 0 < sensor.range_min_m < sensor.range_max_m <= 300
    offsets = sensor.azimuth_offset_rad
    if offsets is not None:
        assert offsets.shape == (sensor.height,)
        assert float(offsets.abs().max()) < math.radians(7)
        assert abs(float(offsets.mean())) < math.radians(1)  # lasers look to either side


def test_json_brings_back_every_number(sensor):
    again = SensorModel.from_json(json.loads(json.dumps(sensor.to_json())))
    assert again.to_json() == sensor.to_json()
    assert again.same_rays(sensor)
    assert ("azimuth_offset_rad" in sensor.to_json()) == (sensor.azimuth_offset_rad is not None)


def test_columns_can_be_changed_and_offsets_stay(sensor):
    wide = sensor.with_columns(512, 4)
    assert (wide.width, wide.fine().width) == (128, 512)
    offsets = (wide.azimuth_offset_rad, sensor.azimuth_offset_rad)
    assert offsets == (None, None) or torch.equal(*offsets)


def test_project_and_unproject_stay_within_half_a_pixel(sensor):
    fine = sensor.fine()
    fine = fine.with_columns(180)
    rng = torch.Generator().manual_seed(0)
    range_m = torch.rand(fine.height, 180, generator=rng) * 60 + 5
    image = RangeImage(range_m, torch.ones_like(range_m, dtype=torch.bool), fine)
    points = unproject(image).points_xyz_m.reshape(-1, 3)
    ring = torch.arange(fine.height).repeat_interleave(180)
    back = project(Scan(points, ring=ring), fine)
    assert torch.equal(back.return_mask, image.return_mask)
    assert torch.allclose(back.range_m, range_m, rtol=1e-5)
    # Points anywhere in their pixels come back within half a pixel of where they were.
    aside = (torch.rand(len(points), generator=rng) - 0.5) * 0.98 * (2 * math.pi / 180)
    turned = torch.stack(
        (
            points[:, 0] * aside.cos() - points[:, 1] * aside.sin(),
            points[:, 0] * aside.sin() + points[:, 1] * aside.cos(),
            points[:, 2],
        ),
        dim=1,
    )
    again = unproject(project(Scan(turned, ring=ring), fine)).points_xyz_m.reshape(-1, 3)
    cosine = torch.nn.functional.cosine_similarity(again.double(), turned.double())
    assert math.degrees(math.acos(float(cosine.clamp(max=1).min()))) <= 1.0 + 1e-2


def test_the_two_blocks_of_the_hdl64e_are_not_linear():
    gap = -load_sensor("hdl64e_kitti_odometry").elevation_rad[:, 0].rad2deg().diff()
    assert float(gap[:31].mean()) == pytest.approx(1 / 3, abs=0.02)
    assert float(gap[32:].mean()) == pytest.approx(1 / 2, abs=0.02)


def test_offsets_are_those_of_the_tables():
    def offset_deg(name: str, row: int) -> float:
        offsets = load_sensor(name).azimuth_offset_rad
        assert offsets is not None
        return math.degrees(float(offsets[row]))

    # Makers count clockwise, these are counter-clockwise.
    assert offset_deg("vlp32c", 31) == pytest.approx(-1.4, abs=1e-4)
    assert [offset_deg("os1_64", row) for row in range(5)] == pytest.approx([-3.164, -1.055, 1.055, 3.164, -3.164])
    assert [offset_deg("pandar64", row) for row in (0, 6, 9)] == pytest.approx([1.042, -1.042, 5.208], abs=1e-4)
    for name in ("hdl32e", "vlp16", "hdl64e_kitti_360", "hdl64e_kitti_odometry"):
        assert load_sensor(name).azimuth_offset_rad is None


def test_the_ouster_table_is_that_of_a_real_unit(real):
    path = next((real / "other_sensors" / "ouster").glob("*.json"))
    about = json.loads(path.read_text(encoding="utf-8"))
    sensor = load_sensor("os1_128")
    assert sensor.elevation_rad[:, 0].rad2deg().tolist() == pytest.approx(about["beam_altitude_angles"], abs=1e-4)
    assert sensor.azimuth_offset_rad is not None
    assert (-sensor.azimuth_offset_rad).rad2deg().tolist() == pytest.approx(about["beam_azimuth_angles"], abs=0.031)


def changed(**entries) -> dict:
    return {**small().to_json(), **entries}


WRONG = {
    "a list": [1, 2],
    "a number": 3,
    "null": None,
    "nothing in it": {},
    "no name": {key: value for key, value in small().to_json().items() if key != "name"},
    "an unknown entry": changed(colour="red"),
    "a number for a name": changed(name=3),
    "a name that cannot be printed": changed(name="\ud800"),
    "a name of two lines": changed(name="a\nb"),
    "words for elevations": changed(elevation_rad="high"),
    "a word among them": changed(elevation_rad=[[0.1], ["x"], [-0.2]]),
    "a flat list": changed(elevation_rad=[0.1, 0.0, -0.2]),
    "rows of several lengths": changed(azimuth_rad=[[0.1, 0.2], [0.3]]),
    "no rows": changed(elevation_rad=[]),
    "empty rows": changed(elevation_rad=[[], [], []]),
    "nested too deep": changed(elevation_rad=[[[0.1]]]),
    "NaN": changed(elevation_rad=[[0.1], [float("nan")], [-0.2]]),
    "infinity": changed(azimuth_rad=[[float("inf")] * 8]),
    "degrees": changed(elevation_rad=[[15.0], [0.0], [-25.0]]),
    "rows that rise": changed(elevation_rad=[[-0.2], [0.0], [0.1]]),
    "columns that turn the other way": changed(azimuth_rad=[[0.1 + 0.7 * i for i in range(8)]]),
    "columns of half the circle": changed(azimuth_rad=[[1.5 - 0.4 * i for i in range(8)]]),
    "columns of each pixel that turn the other way": changed(
        azimuth_rad=[[0.1 + 0.7 * i for i in range(8)]] * 3, elevation_rad=[[0.2] * 8, [0.0] * 8, [-0.2] * 8]
    ),
    "too many rows": changed(elevation_rad=[[1 - 1e-4 * i] for i in range(5000)], azimuth_offset_rad=None),
    "too many pixels": changed(
        elevation_rad=[[1 - 1e-3 * i] for i in range(2000)], azimuth_rad=[[0.0] * 10_000], azimuth_offset_rad=None
    ),
    "a huge stride": changed(column_stride=10**9),
    "a stride of 0": changed(column_stride=0),
    "a stride of a half": changed(column_stride=0.5),
    "an endless number": changed(range_max_m=10**4000),
    "a negative limit": changed(range_min_m=-1.0),
    "limits the wrong way": changed(range_min_m=60.0),
    "NaN for a limit": changed(range_max_m=float("nan")),
    "true for a limit": changed(range_max_m=True),
    "null for a limit": changed(range_max_m=None),
    "another projection": changed(projection="cylinder"),
    "a list for a projection": changed(projection=["spherical"]),
    "too few offsets": changed(azimuth_offset_rad=[0.0]),
    "offsets of rows": changed(azimuth_offset_rad=[[0.0], [0.0], [0.0]]),
    "offsets of turns": changed(azimuth_offset_rad=[0.0, 7.0, 0.0]),
    "NaN among offsets": changed(azimuth_offset_rad=[0.0, float("nan"), 0.0]),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_refuses_a_wrong_sensor_file_in_one_line(wrong, tmp_path):
    path = tmp_path / "wrong.json"
    limit = sys.get_int_max_str_digits()
    sys.set_int_max_str_digits(0)  # to write the endless number; reading goes by the usual limit
    try:
        path.write_text(json.dumps(WRONG[wrong]), encoding="utf-8")
    finally:
        sys.set_int_max_str_digits(limit)
    with pytest.raises(ConfigError) as caught:
        load_sensor(str(path))
    assert "\n" not in str(caught.value)
    assert "wrong.json" in str(caught.value)
    assert len(str(caught.value)) < 600


@pytest.mark.parametrize("text", ["", "{", "\x00\xff", "[" * 100_000, '{"name": "a", "name": 1e999}'])
def test_refuses_what_is_no_json_in_one_line(text, tmp_path):
    path = tmp_path / "odd.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_sensor(str(path))
    assert "\n" not in str(caught.value)


def test_refuses_a_folder_and_what_is_not_there(tmp_path):
    (tmp_path / "folder.json").mkdir()
    for name in ("folder.json", "missing.json"):
        with pytest.raises(ConfigError, match=name):
            load_sensor(str(tmp_path / name))


def test_old_files_without_new_entries_are_read(tmp_path):
    old = {key: value for key, value in small().to_json().items() if key not in ("azimuth_offset_rad", "source")}
    del old["column_stride"]
    path = tmp_path / "old.json"
    path.write_text(json.dumps({**old, "range_max_m": 50}), encoding="utf-8")
    sensor = load_sensor(str(path))
    assert sensor.azimuth_offset_rad is None
    assert sensor.column_stride == 1
    assert isinstance(sensor.range_max_m, float)
    null = SensorModel.from_json({**old, "azimuth_offset_rad": None})
    assert null.azimuth_offset_rad is None


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=2),
    max_leaves=8,
)


@settings(max_examples=150, deadline=None)
@given(st.sampled_from([*small().to_json(), "other"]), json_values)
def test_any_value_anywhere_is_read_or_refused(key, value):
    refused = ""
    try:
        sensor = SensorModel.from_json(changed(**{key: value}))
        assert sensor.height * sensor.width < 1e9
    except LidarGritError as error:
        refused = str(error)
    assert "\n" not in refused


def test_azimuths_go_on_over_the_seam():
    """A table from atan2 jumps by a turn where a column lies on both sides of the back."""
    turn = torch.linspace(3.13, -3.13, 64, dtype=torch.float64)
    table = turn + torch.tensor([[0.03], [-0.03], [0.0]], dtype=torch.float64)
    wrapped = torch.atan2(table.sin(), table.cos())
    assert float((wrapped - table).abs().max()) > 6
    assert torch.allclose(continuous_azimuths_rad(wrapped), table, atol=1e-12)
    assert torch.allclose(continuous_azimuths_rad(wrapped.roll(-1, 1))[:, -1], table[:, 0] - 2 * torch.pi, atol=1e-12)


def test_columns_may_begin_beside_the_half_circle():
    plain = load_sensor("hdl32e")
    edge_rad = math.pi + math.pi / 1024
    turned = replace(
        plain.with_columns(1024), azimuth_rad=column_azimuths_rad(1024, 1, edge_rad), first_edge_rad=edge_rad
    )
    again = SensorModel.from_json(json.loads(json.dumps(turned.to_json())))
    assert again.first_edge_rad == edge_rad
    assert "first_edge_rad" not in plain.to_json()
    few = again.with_columns(512)
    assert float(few.azimuth_rad[0, 0]) == pytest.approx(edge_rad - math.pi / 512, abs=1e-6)
    points = unproject(RangeImage.masked(torch.full((32, 1024), 9.0), torch.ones(32, 1024, dtype=torch.bool), turned))
    near_borders = Scan((points.points_xyz_m / 0.01).round() * 0.01)  # as a driver rounds them
    assert int(project(near_borders, turned, "spherical").return_mask.sum()) == 32 * 1024
    with pytest.raises(ConfigError, match="first_edge_rad=3"):
        replace(plain, first_edge_rad=3.0)


def test_an_ouster_fires_into_the_middle_of_columns():
    for name in ("os1_64", "os1_128"):
        sensor = load_sensor(name)
        fired = sensor.azimuth_rad[0].double() / (2 * math.pi / 1024)
        assert torch.allclose(fired, fired.round(), atol=1e-3)


@pytest.mark.parametrize(("firings", "columns"), [(1024, 1024), (2048, 2048), (1024, 2048), (512, 512)])
def test_no_firing_of_an_ouster_lies_on_a_border_whatever_its_mode(firings, columns):
    sensor = load_sensor("os1_64").with_columns(columns)
    azimuth = 2 * np.pi * np.arange(firings) / firings
    beside = (sensor.first_edge_rad - azimuth) / (2 * np.pi / columns) % 1  # 0 and 1 are the borders
    assert 0.2 < beside.min() <= beside.max() < 0.8
    elevation = sensor.elevation_rad.double().numpy()
    ways = np.broadcast_arrays(
        np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
    )
    fired = Scan(torch.from_numpy((20 * np.stack(ways, axis=-1).reshape(-1, 3) / 0.005).round() * 0.005))
    assert int(project(fired, sensor).return_mask.sum()) == 64 * firings


def test_more_columns_keep_measured_firings_in_their_middle():
    rng = np.random.default_rng(0)
    for own in (90, 360, 1000):
        for columns in (own + 1, 2 * own, 3 * own):
            edge_rad = np.pi + rng.uniform(-1, 1) * np.pi / own
            plain = load_sensor("vlp16").with_columns(own)
            turned = replace(plain, azimuth_rad=column_azimuths_rad(own, 1, edge_rad), first_edge_rad=edge_rad)
            finer = turned.with_columns(columns)
            fired_rad = edge_rad - np.pi / own  # in the middle of the first column
            assert (finer.first_edge_rad - fired_rad) / (2 * np.pi / columns) % 1 == pytest.approx(0.5, abs=1e-6)
            assert finer.fine().same_rays(finer)

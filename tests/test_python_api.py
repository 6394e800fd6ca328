"""``import lidargrit`` as people meet it: arrays of NumPy and tensors of torch go in, whole clouds come out."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

import lidargrit
from lidargrit.core.errors import ConfigError, DataError, ScanError, UnknownNameError
from lidargrit.data import formats
from lidargrit.data.sources.memory import MemorySource
from lidargrit.inference.complete import tasks
from lidargrit.scans.classes import BUILDING, CLASS_BITS, ROAD
from lidargrit.scans.types import RangeImage

SENSOR = lidargrit.load_sensor("hdl64e_kitti_odometry")


@pytest.fixture(scope="module")
def scan():
    return lidargrit.simulate(seed=0)


@pytest.fixture(scope="module")
def nearest():
    return lidargrit.open_model("nearest", sensor=SENSOR.with_columns(512, 2))


def test_dir_names_all_that_there_is():
    assert set(dir(lidargrit)) == {*lidargrit.__all__, "__version__"}
    for name in lidargrit.__all__:
        assert getattr(lidargrit, name) is not None


@pytest.mark.parametrize("convert", [np.float32, np.float64, torch.as_tensor], ids=["float32", "float64", "torch"])
def test_points_of_any_kind_of_array_are_the_same_scan(scan, convert):
    points = scan.points_xyz_m.numpy()
    array = convert(points) if convert is torch.as_tensor else points.astype(convert)
    found = lidargrit.Scan.from_points(array)
    assert torch.equal(found.points_xyz_m, scan.points_xyz_m)
    image = lidargrit.project(scan, SENSOR)
    assert torch.equal(lidargrit.project(array, "hdl64e_kitti_odometry").range_m, image.range_m)


def test_intensity_ring_and_label_come_in_their_usual_scales_and_orders(scan):
    points = scan.points_xyz_m.numpy().astype(np.float64)
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    from_below = np.searchsorted(np.sort(SENSOR.elevation_rad[:, 0].numpy()), elevation).clip(0, 63)
    intensity = np.arange(len(points)) % 256
    found = lidargrit.Scan.from_points(np.column_stack((points, intensity)), ring=from_below, label=[7] * len(points))
    assert found.reflectance is not None
    np.testing.assert_allclose(found.reflectance.numpy(), intensity / 255, atol=1e-6)
    assert found.ring is not None
    np.testing.assert_array_equal(found.ring.numpy(), from_below.max() - from_below)
    assert found.label is not None
    assert found.label.unique().tolist() == [7]


def test_complete_gives_every_point_back_bit_for_bit_and_marks_what_it_added(scan, nearest):
    points = scan.points_xyz_m.numpy()
    ahead = np.abs(np.arctan2(points[:, 1], points[:, 0])) < 0.3
    points = points[~ahead]
    whole = lidargrit.complete(points, nearest).whole()
    assert whole.filled is not None
    np.testing.assert_array_equal(whole.points_xyz_m[~whole.filled].numpy(), points)
    x, y, _ = whole.points_xyz_m[whole.filled].numpy().T
    assert (np.abs(np.arctan2(y, x)) < 0.3).sum() > 0.8 * ahead.sum()


def test_upsample_gives_every_point_back_and_adds_rows(nearest):
    few = lidargrit.simulate(seed=0, sensor=lidargrit.load_sensor("vlp16"))
    whole = lidargrit.upsample(few.points_xyz_m, "vlp16", nearest).whole()
    assert whole.filled is not None
    assert torch.equal(whole.points_xyz_m[~whole.filled], few.points_xyz_m)
    assert bool(whole.filled.any())


def test_raydrop_tells_for_each_point_whether_it_stays_and_a_seed_repeats_it(scan):
    points = scan.points_xyz_m.numpy()
    done = lidargrit.raydrop(points, seed=3)
    assert done.kept.shape == (len(points),)
    assert 0.5 < float(done.kept.float().mean()) < 1
    np.testing.assert_array_equal(done.whole().points_xyz_m.numpy(), points[done.kept.numpy()])
    assert torch.equal(lidargrit.raydrop(points, seed=3).kept, done.kept)


def test_scans_in_memory_score_as_the_same_scans_of_a_source():
    streets = [[lidargrit.simulate(seed=seed).points_xyz_m.numpy() for seed in some] for some in ((0, 1), (2, 3))]
    card = lidargrit.evaluate(*streets, metrics=["point_cloud_jsd"])
    score = card.scores[0].result.value
    same = lidargrit.evaluate(streets[0], streets[0], metrics=["point_cloud_jsd"]).scores[0].result.value
    assert 0 <= same < score < 1
    images = [torch.stack([lidargrit.project(each, SENSOR).range_m for each in some]) for some in streets]
    assert images[0].shape == (2, 64, SENSOR.width)


def test_scans_in_memory_are_scored_with_their_labels_and_reflectance():
    streets = [lidargrit.simulate(seed=seed) for seed in range(2)]
    no_road = [replace(one, label=torch.where(one.label & CLASS_BITS == ROAD, BUILDING, one.label)) for one in streets]
    brighter = [replace(one, reflectance=(one.reflectance + 0.3).clamp(max=1)) for one in streets]
    for metric, changed in (("class_jsd", no_road), ("reflectance_histogram", brighter)):
        of_itself, of_changed = (
            max(score.result.value for score in lidargrit.evaluate(one, streets, metrics=[metric]).scores)
            for one in (streets, changed)
        )
        assert of_itself < 1e-6 < of_changed
    image = lidargrit.project(streets[0], SENSOR)
    read = MemorySource(streets, SENSOR).images().batch([0])
    for plane in ("reflectance", "label"):
        assert torch.equal(read.planes[plane][0], image.planes[plane])


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([[1.0, 2.0, 3.0]], "points as list"),
        (np.ones((5, 2)), r"points of shape \(5, 2\)"),
        (np.ones(3), r"points of shape \(3,\)"),
        (np.array([["a", "b", "c"]]), "values of type"),
        (np.array([[np.nan, 1.0, 1.0], [1.0, 1.0, 1.0]]), "1 of 2 points with NaN"),
        (np.zeros((0, 3)), "no point"),
    ],
)
def test_what_is_no_points_gets_one_line(points, message):
    with pytest.raises(ScanError, match=message) as error:
        lidargrit.complete(points)
    assert "\n" not in str(error.value)


def test_values_that_are_not_one_a_point_are_refused():
    with pytest.raises(ScanError, match=r"ring of shape \(2,\)"):
        lidargrit.Scan.from_points(np.ones((3, 3)), ring=[1, 2])
    with pytest.raises(DataError, match="no scan in memory"):
        lidargrit.evaluate([], [np.ones((3, 3))])


def test_folders_may_be_paths_and_other_mistakes_get_one_line(scan, nearest, tmp_path):
    for number in range(2):
        formats.load("kitti_bin").write(tmp_path / f"{number}.bin", scan)
    card = lidargrit.evaluate(tmp_path, tmp_path, metrics=["return_rate_per_ring"])
    assert [score.result.value for score in card.scores] == [0]
    with pytest.raises(ConfigError, match="none, which does not exist"):
        lidargrit.complete(scan, model=tmp_path / "none")
    with pytest.raises(DataError, match="a single scan in place of a set"):
        lidargrit.evaluate(scan, tmp_path)
    with pytest.raises(ConfigError, match="the seed -1; wanted a whole number"):
        lidargrit.complete(scan, model=nearest, seed=-1)


def test_sensors_are_named_given_or_in_a_file(scan, tmp_path):
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(SENSOR.with_columns(256).to_json()))
    images = [lidargrit.project(scan.points_xyz_m, each) for each in (path, str(path), lidargrit.load_sensor(path))]
    assert all(torch.equal(image.range_m, images[0].range_m) for image in images)
    fates = [lidargrit.inspect(scan.points_xyz_m, each).fate for each in (path, str(path))]
    np.testing.assert_array_equal(*fates)
    streets = [lidargrit.simulate(1, each, kept_columns_only=True) for each in (path, SENSOR.with_columns(256))]
    assert torch.equal(streets[0].points_xyz_m, streets[1].points_xyz_m)


def test_range_images_in_memory_are_scored_as_the_samples_that_they_are(scan):
    streets = [lidargrit.simulate(seed=seed) for seed in (1, 2)]
    images = RangeImage.stack([lidargrit.project(each, SENSOR) for each in streets])
    found, of_points = (
        lidargrit.evaluate(each, [scan, scan], metrics=["point_cloud_jsd"]).scores[0].result.value
        for each in (images, streets)
    )
    assert found == of_points
    with pytest.raises(ScanError, match=r"points as RangeImage; .*; take its points: lidargrit\.unproject\(image\)"):
        lidargrit.complete(images[0])


def test_another_sensor_than_the_points_is_doubted_aloud_and_once(scan, nearest, monkeypatch):
    monkeypatch.setattr(tasks, "_doubted", set())
    with pytest.warns(UserWarning, match="of two lasers"):
        lidargrit.upsample(scan.points_xyz_m, "vlp16", nearest)
    lidargrit.upsample(scan.points_xyz_m[1000:], "vlp16", nearest)
    card = lidargrit.evaluate([scan], [scan], metrics=["point_cloud_jsd"], sensor="vlp16")
    assert any("of two lasers" in warning for warning in card.warnings)
    with pytest.raises(ConfigError, match="vlp16"):
        lidargrit.complete(scan, nearest, sensor="vlp16")


def test_models_of_another_kind_are_refused_in_one_line(scan):
    loaded = lidargrit.load("pretrained")
    with pytest.raises(ConfigError, match=r"a LidarGrit as the model; .*; lidargrit\.open_model\(NAME\)"):
        lidargrit.complete(scan, loaded)
    with pytest.raises(ConfigError, match=r'a LidarGrit as the model; .*; lidargrit\.load\(NAME, "segment"\)'):
        lidargrit.segment(scan, loaded)


def test_points_that_are_masked_or_of_16_bits_are_none_and_numbers():
    points = np.array([[3.0, 0, 0], [0, 4, 0], [0, 0.5, 5]])
    mask = [[False] * 3, [True, False, False], [False] * 3]
    kept = lidargrit.Scan.from_points(np.ma.masked_array(points, mask), bad_points="drop")
    np.testing.assert_array_equal(kept.points_xyz_m.numpy(), points[[0, 2]])
    short = lidargrit.Scan.from_points(torch.tensor(points, dtype=torch.bfloat16))
    np.testing.assert_array_equal(short.points_xyz_m.numpy(), points)
    with pytest.raises(UnknownNameError, match=r"bad_points='Drop'; wanted .*refuse"):
        lidargrit.Scan.from_points(points, bad_points="Drop")

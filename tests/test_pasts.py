"""From drives on disk to the past of each training image, and where a drive ends."""

import numpy as np
import pytest
import torch

from lidargrit.cli import main
from lidargrit.core.errors import DataError
from lidargrit.data.batches import Batches
from lidargrit.data.drives import DriveConfig, write_drives
from lidargrit.data.pasts import Pasts
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.prepared.prepare import prepare
from lidargrit.data.sources import load_range_images
from lidargrit.data.windows import TimedScan, drives_in
from lidargrit.generation import conditions
from lidargrit.generation.generator import load
from lidargrit.generation.presets import load_preset
from lidargrit.generation.settings import Preset, TrainingConfig
from lidargrit.inference.compress.scan_codec import ScanCodec
from lidargrit.scans.motion import Motion
from lidargrit.scans.past import Past
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.warp import warp
from lidargrit.systems.forecaster.system import Forecaster, ForecasterObjective
from lidargrit.training import train
from lidargrit.training.compute import uniform_images

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(128, 4)
CONFIG = DataConfig(columns=128, column_stride=4, workers=1)


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    """Two streets of three scans each, prepared with all columns, and their tree."""
    folder = tmp_path_factory.mktemp("drives")
    write_drives(folder / "tree", 6, DriveConfig(SENSOR.fine(), seed=5, frames=3))
    prepare(f"kitti_odometry:{folder / 'tree'}:all", CONFIG, folder / "prepared")
    return folder


def test_the_past_of_prepared_images_is_that_of_their_files(drives):
    images = load_range_images([str(drives / "prepared")], CONFIG)
    fine = load_range_images([str(drives / "prepared")], DataConfig(columns=128, workers=1))
    pasts = Pasts(images, 2)
    assert pasts.drives == [[0, 1, 2], [3, 4, 5]]
    past = pasts.of([5, 3, 4], gaps=[1, 1, 1])
    assert torch.equal(past.range_m[0], fine.batch([3, 4]).range_m)
    assert not past.range_m[1].any()
    assert not past.range_m[2, 0].any()
    assert past.ages_s[0].tolist() == pytest.approx([0.2, 0.1])
    assert torch.equal(pasts.of([5], gaps=[2]).range_m[0, 1], past.range_m[0, 0])
    rows = np.loadtxt(drives / "tree" / "sequences" / "01" / "poses.txt").reshape(-1, 3, 4)
    ahead_m = rows[2, 2, 3] - rows[1, 2, 3]  # a camera looks along z, a sensor along x
    assert float(past.transforms[0, 1, 0, 3]) == pytest.approx(-ahead_m, abs=1e-3)
    assert Pasts(images, 1).of([4], [2]).range_m[0, 0].equal(fine.batch([3]).range_m[0].roll(-2, -1))


def test_batches_tell_the_past_of_images_that_begin_anywhere_and_are_turned(drives):
    """A warped past predicts its own image far better than the one beside it, however that was turned."""
    images = load_range_images([str(drives / "prepared")], CONFIG)
    batches = Batches(images, 6, ("flip", "roll"), True, 1, past_scans=2)
    example, again = batches.at(0), Batches(images, 6, ("flip", "roll"), True, 1, past_scans=2).at(0)
    assert isinstance(example.condition, Past)
    assert isinstance(again.condition, Past)
    assert torch.equal(example.condition.range_m, again.condition.range_m)
    with_past = [at for at in range(6) if example.condition.range_m[at].any()]
    assert len(with_past) == 4
    warped = warp(example.condition).last

    def error_m(of: int, by: int) -> float:
        true_m = example.images.range_m[of].double()
        both = warped.mask[by] & (true_m > 0)
        return float((warped.range_m[by] - true_m)[both].abs().median())

    for at in with_past:
        assert error_m(at, at) < 0.2
        assert all(error_m(other, at) > 0.5 for other in range(6) if other != at)


def test_a_forecaster_is_told_as_many_past_scans_as_its_configuration_says(drives, tmp_path, monkeypatch):
    """In training, validation, evaluation, forecasts and compression; five were told in training whatever it said."""
    told, decoded, sample = set[int](), ForecasterObjective.decoded, Forecaster._sample

    def learn(objective, example, rng):
        told.add(example.condition.range_m.shape[1])
        return decoded(objective, example, rng)

    def forecast(model, seeds, condition, sampling):
        forecast_from.append(condition.range_m.shape[1])
        return sample(model, seeds, condition, sampling)

    monkeypatch.setattr(ForecasterObjective, "decoded", learn)
    monkeypatch.setattr(Forecaster, "_sample", forecast)
    monkeypatch.setenv("LIDARGRIT_CACHE", str(tmp_path / "cache"))
    source, run, forecast_from = (str(drives / "prepared"),), tmp_path / "run", list[int]()
    data = DataConfig(source, source, columns=128, column_stride=4, workers=1, condition="past")
    fit = TrainingConfig(2, 2, 1e-3, validate_every=2, validation_scans=2, checkpoint_every=2, average_over_scans=0)
    train(Preset("two scans", "forecaster", Forecaster.smallest_config(SENSOR), data, {"pixels": fit}), run)
    assert told == {2}
    assert load(run).past_scans == ScanCodec(load(run), 10).past_scans == 2
    tree = f"kitti_odometry:{drives / 'tree'}:01"  # whose car moves
    assert main(["forecast", tree, str(tmp_path / "next"), "--model", str(run), "-n", "2"]) == 0
    words = ["--protocol", "forecast", "--model", str(run), "--set", "data.columns=128", "data.column_stride=4"]
    assert main(["evaluate", tree, *words]) == 0  # three scans are enough
    assert {*forecast_from} == {2}


def test_images_without_a_drive_tell_as_many_empty_scans_as_the_generator_takes():
    preset = load_preset("forecaster_compact", ["model.past_scans=3"])
    generator = preset.build_generator()
    told = conditions.load("past", generator.past_scans).of(uniform_images(generator.sensor, 2))
    assert told.range_m.shape[:2] == (2, 3)


def moving(times_s: list[float | None], places_m: list[float | None]) -> list[TimedScan]:
    found = []
    for number, (time_s, place_m) in enumerate(zip(times_s, places_m, strict=True)):
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3] = place_m or 0.0
        found.append(TimedScan(f"scan {number}", "a", Motion(time_s, None if place_m is None else pose)))
    return found


@pytest.mark.parametrize(
    ("times_s", "places_m", "drives", "told"),
    [
        ([0, 0.1, 0.2, 0.36, 0.46], [0, 1, 2, 3, 4], [[0, 1, 2], [3, 4]], "a gap above 1.5 periods of 0.1 s"),
        ([0, 0.1, 0.2, 0.34, 0.44], [0, 1, 2, 3, 4], [[0, 1, 2, 3, 4]], ""),
        ([0, 0.1, 0.2, 0.3], [0, 1, 7.5, 8], [[0, 1], [2, 3]], "a jump above 60 m/s (1 times, first before scan 2)"),
        ([0, 0.1, 0.1, 0.2], [0, 1, 1, 2], [[0, 1], [2, 3]], "a repeated time"),
        ([0.2, 0.1, 0.0], [2, 1, 0], [[0], [1], [2]], "a time before the last (2 times, first before scan 1)"),
        ([0, 0.1, None, 0.2], [0, 1, 1, None], [[0, 1]], "2 scans have no time or no pose, such as scan 2"),
    ],
)
def test_drives_end_where_time_or_place_jump_and_say_so(times_s, places_m, drives, told, heard):
    assert drives_in(moving(times_s, places_m)) == drives
    assert told in "\n".join(heard)


def test_images_that_are_no_drive_are_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("LIDARGRIT_CACHE", str(tmp_path))
    with pytest.raises(DataError, match=r"none follows another in a drive.*simulate DRIVES --frames 12"):
        Pasts(load_range_images(["simulated:2:test"], CONFIG), 3)

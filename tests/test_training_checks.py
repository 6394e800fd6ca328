"""What a training refuses before its first stage, and what it keeps when something beside it fails."""

import itertools
import json
import os
import signal
import sys
import threading

import numpy as np
import pytest

from lidargrit.cli import main
from lidargrit.core import reporting
from lidargrit.core.errors import ConfigError, DataError, Terminated
from lidargrit.data.batches import Batches
from lidargrit.data.images import Pixels, Provenance, RangeImages
from lidargrit.data.prepared.workers import _made_by_processes
from lidargrit.data.sources import load_range_images
from lidargrit.generation.presets import load_preset
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.training import train
from lidargrit.training.engine import Engine
from lidargrit.training.plan import check_stages
from lidargrit.training.stage import StageTraining
from test_tracking import StandIn
from test_training import TINY
from tiny_runs import the_one_line, train_words

VALIDATING = [
    f"training.{stage}.{setting}" for stage in ("tokenizer", "transformer") for setting in ("validate_every=4",)
]


class Without(RangeImages):
    """Images that lack something."""

    def __init__(self, images: RangeImages, **lacking: None) -> None:
        super().__init__(images.sensor, images._stores)
        self.lacking = lacking

    def batch(self, indices, first_columns=None) -> RangeImage:
        return super().batch(indices, first_columns).with_planes(**self.lacking)


@pytest.mark.parametrize(
    ("name", "settings", "lacking", "stage"),
    [
        ("completion_compact", ["model.completion.labels=true"], "label", "completion"),
        ("r2dm_small", ["model.reflectance=true"], "reflectance", "diffusion"),
        ("r2flow_small", ["model.reflectance=true"], "reflectance", "flow"),
        ("lidargen_small", ["model.reflectance=true"], "reflectance", "score"),
        ("lidargrit_small", ["model.tokenizer.reflectance=true"], "reflectance", "tokenizer"),
    ],
)
def test_images_without_what_a_stage_learns_from_are_refused(name, settings, lacking, stage):
    preset = load_preset(name, settings)
    checked, images = check_stages(preset), load_range_images(("simulated:1:val",), preset.data)
    checked.check_images("data.val", images)
    with pytest.raises(ConfigError, match=rf"got data\.val, for the stage {stage}: .*scans without {lacking}"):
        checked.check_images("data.val", Without(images, **{lacking: None}))


def test_unmarked_surfaces_are_refused_before_any_stage():
    checked = check_stages(load_preset("raydrop_compact"))
    images = load_range_images(("simulated:1:val",), load_preset("raydrop_compact").data)
    with pytest.raises(ConfigError, match=r"data\.train, for the stage raydrop: training scans that do not mark"):
        checked.check_images("data.train", images)


def test_validation_scans_are_looked_for_before_training_scans_are_projected(tmp_path):
    class Projecting(reporting.Reporter):
        def progress(self, what, total, done=0):
            raise AssertionError(what)

    with pytest.raises(DataError, match="nowhere"), reporting.to(Projecting()):
        train(load_preset("lidargrit_demo", [*TINY, f"data.val={tmp_path / 'nowhere'}"]), tmp_path / "run")


def test_a_validation_that_fails_leaves_the_checkpoint(tmp_path, monkeypatch):
    def fails(*_):
        raise DataError("a validation scan that is gone", "one that is there", "restore it")

    unbroken, preset = tmp_path / "unbroken", load_preset("lidargrit_demo", [*TINY, *VALIDATING])
    train(preset, unbroken)
    with monkeypatch.context() as patched:
        patched.setattr(StageTraining, "validate", fails)
        with pytest.raises(DataError, match="that is gone"):
            train(preset, tmp_path / "run")
    assert (tmp_path / "run" / "tokenizer" / "checkpoint.safetensors").is_file()
    train(preset, tmp_path / "run")  # the validation that was missed comes first
    logs = [(folder / "tokenizer" / "log.jsonl").read_text() for folder in (unbroken, tmp_path / "run")]
    entries = [[{**json.loads(line), "seconds": 0} for line in log.splitlines()] for log in logs]
    assert entries[0] == entries[1]
    assert [entry["scans_seen"] for entry in entries[0] if entry["split"] == "val"] == [4, 8, 12]


def test_a_terminated_training_does_not_validate_first(tmp_path, monkeypatch):
    def validates(*_):
        raise AssertionError("a validation")

    def step(self, images):
        os.kill(os.getpid(), signal.SIGTERM)
        return before(self, images)

    before = StageTraining._step
    monkeypatch.setattr(StageTraining, "validate", validates)
    monkeypatch.setattr(StageTraining, "_step", step)
    settings = [f"training.{stage}.validate_every=2" for stage in ("tokenizer", "transformer")]
    with pytest.raises(Terminated):
        train(load_preset("lidargrit_demo", [*TINY, *settings]), tmp_path / "run")
    assert (tmp_path / "run" / "tokenizer" / "checkpoint.safetensors").is_file()


def test_a_training_that_is_terminated_while_it_validates_loses_no_step(tmp_path, monkeypatch):
    def evaluate(self, objective, images, seed):
        os.kill(os.getpid(), signal.SIGTERM)
        calls.append(seed)
        return before(self, objective, images, seed)

    calls, before = [], Engine.evaluate
    monkeypatch.setattr(Engine, "evaluate", evaluate)
    settings = ("validate_every=4", "checkpoint_every=1000", "batch_size=1", "validation_scans=2")
    preset = load_preset("lidargrit_demo", [*TINY, *(f"training.tokenizer.{setting}" for setting in settings)])
    with pytest.raises(Terminated):
        train(preset, tmp_path / "run")
    assert len(calls) == 1, "the second scan is left out"
    assert (tmp_path / "run" / "tokenizer" / "checkpoint.safetensors").is_file()


def test_as_many_batches_are_read_at_once_as_there_are_workers():
    sensor = load_sensor("hdl64e_kitti_odometry")

    class Meeting:
        """A store that answers its first twelve requests once all of them are open."""

        provenance = Provenance()

        def __init__(self) -> None:
            self.barrier, self.requests = threading.Barrier(12, timeout=20), itertools.count()

        def __len__(self) -> int:
            return 24

        def read(self, index: int) -> Pixels:
            if next(self.requests) < 12:
                self.barrier.wait()
            return Pixels(range_m)

    range_m = np.full((sensor.height, sensor.width), 10, np.float32)
    batches = Batches(RangeImages(sensor, [Meeting()]), 1, (), False, 0, workers=12)
    assert len(list(batches.stream(0, 24))) == 24


def test_a_launcher_that_numbers_no_local_process_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("RANK", "0")
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(ConfigError, match="WORLD_SIZE=2 without LOCAL_RANK"):
        train(load_preset("lidargrit_demo", TINY), tmp_path / "run")


def test_a_refused_training_does_not_touch_the_tracked_run(tmp_path, monkeypatch, capsys):
    stand_in = StandIn()
    monkeypatch.setitem(sys.modules, "wandb", stand_in)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "notes.txt").write_text("mine")
    assert main([*train_words(tmp_path / "run"), "--wandb", "lidar"]) == 2
    assert "which is not empty" in the_one_line(capsys.readouterr().err, "train")
    assert stand_in.begun == []


def test_a_process_that_dies_ends_the_others(tmp_path, monkeypatch):
    """One dies at once, and the other would go on for a minute."""
    script = tmp_path / "worker.py"
    script.write_text("import sys, time\ntime.sleep(60 * (sys.argv[-1] == '1'))\nsys.exit(9)\n")
    command = [sys.executable, str(script)]
    monkeypatch.setattr("lidargrit.data.prepared.workers.module_command", lambda *_: command)
    with pytest.raises(DataError, match="a process that died while projecting"):
        list(_made_by_processes(tmp_path, [[0], [1]]))


def test_compiling_without_a_compiler_is_refused_before_the_first_stage(tmp_path, monkeypatch):
    monkeypatch.setenv("CXX", str(tmp_path / "none"))
    with pytest.raises(ConfigError, match=r"compile=true and no C\+\+ compiler"):
        check_stages(load_preset("lidargrit_small", ["training.transformer.compile=true"]))

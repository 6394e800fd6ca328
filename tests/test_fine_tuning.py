"""The networks of the package, trained further on a user's scans by one verb."""

import json
import shlex

import pytest
import torch

import lidargrit
from lidargrit.cli import main
from lidargrit.core.errors import ConfigError
from lidargrit.data.export import export_scans
from lidargrit.scans.sensors import load_sensor
from lidargrit.training.fine_tuning import columns_like, fine_tuning_preset
from lidargrit.training.measure import Measured

FEW = [
    f"training.{stage}.{what}"
    for stage in ("tokenizer", "transformer", "pixels")
    for what in ("scans=2", "batch_size=1")
]


@pytest.fixture(scope="module")
def scans(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scans") / "mine"
    export_scans("simulated:4:test", folder, "kitti_bin")
    return folder


def test_scans_seen_grow_with_the_scans_that_there_are_and_some_are_held_out(scans):
    preset = fine_tuning_preset(str(scans))
    assert preset.training["transformer"].scans == 800
    assert (preset.data.train, preset.data.val) == ((f"folder:{scans}:all[:85%]",), (f"folder:{scans}:all[85%:]",))
    many = fine_tuning_preset("simulated:500:train")
    assert many.training["transformer"].scans == 8000
    assert many.data.load_sensor().same_rays(lidargrit.load("pretrained").sensor)


def test_of_scans_named_to_validate_on_none_is_held_out(scans, capsys):
    one, other = "simulated:1:train", "simulated:1:val"
    preset = fine_tuning_preset(one, val=other)
    assert (preset.data.train, preset.data.val) == ((one,), (other,))
    assert main(["fine-tune", one, str(scans.parent / "out"), "--val", "nowhere", "--dry-run"]) == 2
    assert "got nowhere, which does not exist" in capsys.readouterr().err


def test_images_of_another_sensor_of_64_rows_are_as_wide_as_the_models():
    own = lidargrit.load("pretrained").sensor
    assert columns_like(own, load_sensor("os1_64")) == (1024, 4)
    assert columns_like(own, load_sensor("pandar64"))[0] % own.width == 0


@pytest.mark.parametrize("sensor", ["vlp16", "os1_128"])
def test_scans_of_other_rows_are_refused_with_a_command_that_plans_a_training(sensor, capsys):
    with pytest.raises(ConfigError, match=f"scans of {load_sensor(sensor).height} rows") as refused:
        fine_tuning_preset("simulated:8:train", sensor)
    typed = shlex.split(refused.value.cure.partition("lidargrit ")[2])
    assert main([*typed, "--dry-run"]) == 0, capsys.readouterr().err
    assert f"range images of {load_sensor(sensor).height}x256" in capsys.readouterr().out


def test_the_verb_tells_the_time_trains_all_stages(scans, tmp_path, capsys, monkeypatch):
    def measured(_preset, flops):  # steps of networks of this size take seconds each
        return [Measured(stage, of, 1.0, 20.0, "cpu", 0.5) for stage, of in flops.items()]

    monkeypatch.setattr("lidargrit.training.measure", measured)
    monkeypatch.setattr("lidargrit.training.plan.training_flops", lambda preset: dict.fromkeys(preset.training, 1))
    out = tmp_path / "run"
    words = ["fine-tune", str(scans), str(out), "--set", *FEW]
    assert main(words) == 0
    said = capsys.readouterr()
    assert "scans seen: tokenizer 2, transformer 2, pixels 2" in said.err
    assert "training takes about 60 s at" in said.err
    before, after = lidargrit.load("pretrained"), lidargrit.load(str(out))
    for stage in after.stages:
        pairs = zip(
            before.objective(stage).state_dict().values(), after.objective(stage).state_dict().values(), strict=True
        )
        assert any(not torch.equal(old, new) for old, new in pairs), f"{stage} was trained"
    training = json.loads((out / "run.json").read_text())["preset"]["training"]
    assert {stage: config["start"] for stage, config in training.items()} == dict.fromkeys(after.stages, "pretrained")


@pytest.mark.parametrize("val", [[], ["--val", "simulated:1:val"]])
def test_a_named_sensor_is_not_looked_for(scans, capsys, val):
    assert main(["fine-tune", str(scans), str(scans.parent / "out"), "--sensor", "vlp16", *val]) == 2
    told = capsys.readouterr().err
    assert "of the sensor 'vlp16'" in told
    assert "no sensor is named" not in told


def test_too_few_scans_are_refused_in_one_line(tmp_path, capsys):
    export_scans("simulated:2:test", tmp_path / "two", "kitti_bin")
    assert main(["fine-tune", str(tmp_path / "two"), str(tmp_path / "run")]) == 2
    assert "at least 4, to hold one out" in capsys.readouterr().err

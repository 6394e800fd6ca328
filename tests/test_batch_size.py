"""batch_size=auto: batches that the machine gains by, and the learning rate that goes with them."""

import math
from dataclasses import replace

import pytest

from lidargrit.cli import main
from lidargrit.core import configuration
from lidargrit.core.errors import ConfigError
from lidargrit.core.files import write_json
from lidargrit.generation.presets import load_preset
from lidargrit.nn.size import TooLargeError
from lidargrit.training import batch_size, with_best_batches, without_auto
from test_training import TINY
from tiny_runs import the_one_line


def preset_of(scans=64_000):
    preset = load_preset("lidargrit_small")
    tokenizer = replace(preset.settings_of("tokenizer"), scans=scans, batch_size=4, learning_rate=1e-3)
    return replace(preset, training={**preset.training, "tokenizer": tokenizer})


def chosen(monkeypatch, folder, rates, scans=64_000):
    """Return the settings that are found where batches of a size are trained at these rates; None is too large."""

    def scans_per_s(preset, stage):
        size = preset.settings_of(stage).batch_size
        if rates[size] is None:
            raise TooLargeError(f"{size} scans at once", "fewer", "")
        return rates[size]

    monkeypatch.setattr(batch_size, "scans_per_s", scans_per_s)
    return with_best_batches(preset_of(scans), ["tokenizer"], folder).settings_of("tokenizer")


@pytest.mark.parametrize(
    ("rates", "size"),
    [
        ({4: 10.0, 8: 10.9}, 4),
        ({4: 10.0, 8: 15.0, 16: 16.0}, 8),
        ({4: 10.0, 8: 20.0, 16: 40.0, 32: 80.0, 64: 160.0}, 64),
        ({4: 10.0, 8: 20.0, 16: None}, 8),
        ({4: None}, 4),
    ],
)
def test_batches_grow_while_the_machine_gains_by_it(monkeypatch, tmp_path, rates, size):
    found = chosen(monkeypatch, tmp_path, rates)
    assert found.batch_size == size
    assert found.learning_rate == pytest.approx(1e-3 * math.sqrt(size / 4))
    assert replace(found, batch_size=4, learning_rate=1e-3) == preset_of().settings_of("tokenizer")


def test_a_thousand_steps_are_left(monkeypatch, tmp_path):
    doubling = {4 * 2**n: 2.0**n for n in range(5)}
    assert chosen(monkeypatch, tmp_path, doubling, scans=16_000).batch_size == 16
    assert chosen(monkeypatch, tmp_path, doubling, scans=15_999).batch_size == 8


def test_a_run_that_began_goes_on_with_its_sizes(monkeypatch, tmp_path):
    began = preset_of()
    sizes = replace(began.settings_of("tokenizer"), batch_size=12, learning_rate=0.5)
    began = replace(began, training={**began.training, "tokenizer": sizes})
    write_json(tmp_path / "run.json", {"preset": configuration.to_json(began)})
    assert chosen(monkeypatch, tmp_path, {}) == sizes


def test_several_processes_are_told_to_name_a_number(monkeypatch, tmp_path):
    monkeypatch.setenv("WORLD_SIZE", "4")
    monkeypatch.setenv("RANK", "0")
    with pytest.raises(ConfigError, match="batch_size=auto in 4 processes; wanted a number"):
        chosen(monkeypatch, tmp_path, {})


def test_the_command_measures_and_trains_by_what_it_found(monkeypatch, tmp_path, capsys):
    measured = []
    timed = batch_size.scans_per_s
    monkeypatch.setattr(batch_size, "_STEPS_AT_LEAST", 1)
    monkeypatch.setattr(batch_size, "_GAIN", 0.0)  # so that every size is taken, however fast it is

    def scans_per_s(preset, stage):
        measured.append((preset.settings_of(stage).batch_size, timed(preset, stage)))
        return measured[-1][1]

    monkeypatch.setattr(batch_size, "scans_per_s", scans_per_s)
    words = [*TINY, "training.tokenizer.scans=8", "training.tokenizer.batch_size=auto"]
    words = [word for word in words if word != "training.tokenizer.batch_size=2"]
    main(["train", "lidargrit_small", str(tmp_path / "run"), "--dry-run", "--set", *words])
    told = capsys.readouterr().out
    assert all(rate > 0 for _, rate in measured)
    assert f"training.tokenizer.batch_size = {measured[-1][0]}" in told
    assert len(measured) > 1


def test_unknown_stages_are_told(capsys):
    assert without_auto(["training.tokenizer.batch_size=auto", "seed=1"]) == (["seed=1"], ["tokenizer"])
    assert main(["train", "lidargrit_small", "never", "--dry-run", "--set", "training.tokeniser.batch_size=auto"]) == 2
    assert "wanted tokenizer" in the_one_line(capsys.readouterr().err, "train")

"""What is sent to Weights & Biases, by a stand-in for its package."""

import sys
import types

import pytest

from lidargrit.cli import main
from lidargrit.generation.presets import load_preset
from lidargrit.training.run import tracked
from tiny_runs import the_one_line, train_words

PRESET = load_preset("lidargrit_demo")


class StandIn(types.ModuleType):
    """Takes notes."""

    def __init__(self) -> None:
        super().__init__("wandb")
        self.begun: list[dict] = []
        self.ended: list[int] = []

    def init(self, **words):
        if words["project"] == "forbidden":
            raise RuntimeError("no key\nlong story")
        self.begun.append(words)
        return self

    def finish(self, exit_code: int) -> None:
        self.ended.append(exit_code)


@pytest.fixture
def wandb(monkeypatch):
    stand_in = StandIn()
    monkeypatch.setitem(sys.modules, "wandb", stand_in)
    return stand_in


def test_a_run_that_goes_on_is_the_same_run_there(wandb, tmp_path):
    for _ in range(2):
        with tracked("lidar", PRESET, tmp_path / "mine"):
            assert len(wandb.ended) < len(wandb.begun)
    first, again = wandb.begun
    assert first == again
    assert first["name"] == "mine"
    assert first["resume"] == "allow"
    assert first["sync_tensorboard"] is True
    assert first["config"]["model"]["transformer"]["layers"] == PRESET.model.transformer.layers
    with tracked("lidar", PRESET, tmp_path / "other"):
        pass
    assert wandb.begun[2]["id"] != first["id"]
    assert wandb.ended == [0, 0, 0]


def test_a_run_that_fails_is_told_as_failed(wandb, tmp_path):
    with pytest.raises(KeyboardInterrupt), tracked("lidar", PRESET, tmp_path):
        raise KeyboardInterrupt
    assert wandb.ended == [1]


def test_nothing_is_sent_unless_asked_for_and_by_the_first_process_only(wandb, tmp_path, monkeypatch):
    with tracked("", PRESET, tmp_path):
        pass
    monkeypatch.setenv("RANK", "1")
    monkeypatch.setenv("WORLD_SIZE", "2")
    with tracked("lidar", PRESET, tmp_path):
        pass
    assert wandb.begun == []


def test_a_missing_package_or_a_refusal_is_told_in_one_line(wandb, tmp_path, monkeypatch, capsys):
    assert main([*train_words(tmp_path / "run"), "--wandb", "forbidden"]) == 2
    assert "--wandb forbidden, where RuntimeError: no key;" in the_one_line(capsys.readouterr().err, "train")
    monkeypatch.setitem(sys.modules, "wandb", None)
    assert main([*train_words(tmp_path / "run"), "--wandb", "lidar"]) == 2
    assert "pip install 'lidargrit[wandb]'" in the_one_line(capsys.readouterr().err, "train")
    assert not (tmp_path / "run").exists()

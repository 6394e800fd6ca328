"""A second tokenizer, through everything that a generator over tokens does: train, sample, evaluate, serve."""

import io
import json
import sys

import pytest
import torch

from lidargrit.cli import main
from lidargrit.core import configuration
from lidargrit.core.configuration import changed
from lidargrit.core.errors import ConfigError, LidarGritError, OutputError
from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.generator import load, load_class
from lidargrit.generation.settings import Preset, TrainingConfig
from lidargrit.generation.tokenizers.vqvae import VqvaeConfig
from lidargrit.nn.transformer import TransformerConfig
from lidargrit.systems.lidargrit.system import LidarGritConfig
from lidargrit.systems.maskgit.system import MaskGitConfig
from lidargrit.training import train
from lidargrit.viewer.serve.worker import run_worker
from toy_tokenizer import NAME, installed

CONFIGS = {"lidargrit": LidarGritConfig, "maskgit": MaskGitConfig}
FIT = TrainingConfig(scans=8, batch_size=4, learning_rate=0.1, average_over_scans=0)


def preset_of(generator, tokenizer):
    return Preset(
        title="a toy",
        generator=generator,
        model=CONFIGS[generator](tokenizer, TransformerConfig(layers=1, heads=2, width=16)),
        data=DataConfig(("simulated:4:train",), ("simulated:2:val",), columns=512, column_stride=8),
        training={"tokenizer": FIT, "transformer": FIT},
    )


@pytest.mark.parametrize("generator", CONFIGS)
def test_a_second_tokenizer_trains_samples_and_is_scored_and_served(generator, tmp_path, monkeypatch, capsys, heard):
    toy, folder, samples = installed(monkeypatch), tmp_path / "run", tmp_path / "samples"
    preset = preset_of(generator, toy(noise_m=0.2))
    trained = train(preset, folder)
    assert any("this tokenizer is a toy" in line for line in heard)
    assert float(trained.get_tokenizer().logits.detach().abs().max()) > 0, "it has learned"
    train(preset, folder)  # the same preset is recognised, and nothing is left to do
    with pytest.raises(OutputError, match=r"there model\.tokenizer\.noise_m=0\.2, here 0\.3"):
        train(preset_of(generator, toy(noise_m=0.3)), folder)
    with pytest.raises(OutputError, match=r"another run"):
        train(preset_of(generator, VqvaeConfig()), folder)

    written = json.loads((folder / "config.json").read_text())["config"]["tokenizer"]
    assert written == {"name": NAME, "block": 8, "levels": 16, "noise_m": 0.2}
    read = load(folder)
    assert read.config == preset.model
    seeds = [0, 1, 2]
    images = read.sample(seeds)
    assert torch.equal(images.range_m, trained.sample(seeds).range_m)
    assert torch.equal(read.sample([1]).range_m[0], images.range_m[1]), "its noise is the seed's own"
    assert images.range_m[images.return_mask].unique().numel() > 1000, "ranges are sampled, not one a level"
    assert images.reflectance is not None
    assert read.reconstruct(images).range_m.unique().numel() <= 17
    assert read.cost().flops == read.cost(read.Sampling()).flops > 0

    assert main(["sample", str(folder), str(samples), "-n", "4"]) == 0
    assert main(["evaluate", str(samples), "simulated:4:val"]) == 0
    assert "jsd" in capsys.readouterr().out
    request = {"model": 0, "seed": 0, "count": 1, "sampling": {}, "file": "", "name": "", "task": "returns"}
    line = json.dumps({"request": request, "folder": str(tmp_path)})
    monkeypatch.setattr(sys, "stdin", io.StringIO(line + "\n"))
    run_worker([folder], "cpu")
    models, answer = (json.loads(line) for line in capsys.readouterr().out.splitlines())
    assert models["models"][0]["generator"] == generator
    assert "refused" not in answer
    assert (tmp_path / "pixels.npz").exists()


def test_a_trained_tokenizer_is_taken_by_another_run_of_its_kind(tmp_path, monkeypatch):
    toy = installed(monkeypatch)

    def taking(preset: Preset) -> Preset:
        return changed(preset, {"training.tokenizer.start": f"frozen:{tmp_path / 'first'}"})

    first = train(preset_of("lidargrit", toy()), tmp_path / "first")
    second = train(taking(preset_of("maskgit", toy())), tmp_path / "second")
    theirs, ours = first.get_tokenizer().state_dict(), second.get_tokenizer().state_dict()
    assert all(torch.equal(weight, ours[name]) for name, weight in theirs.items())
    other = taking(preset_of("maskgit", VqvaeConfig()))
    with pytest.raises(ConfigError, match=rf"whose tokenizer is another \(model\.tokenizer\.name={NAME}\)"):
        train(other, tmp_path / "third")


@pytest.mark.parametrize("generator", CONFIGS)
def test_a_vqvae_is_written_without_a_name_and_read_with_or_without(generator):
    cls = load_class(generator).Config
    config = cls(VqvaeConfig(num_codes=64))
    data = configuration.to_json(config)
    assert "name" not in data["tokenizer"]
    assert configuration.from_json(cls, data, "config.json") == config
    named = data | {"tokenizer": {"name": "vqvae", **data["tokenizer"]}}
    assert configuration.from_json(cls, named, "config.json") == config


@pytest.mark.parametrize(
    ("tokenizer", "message"),
    [
        ({"name": "vqvea"}, r"got 'vqvea', which is not among the tokenizers; wanted one such as vqvae or curve_vqvae"),
        ({"name": ["vqvae"]}, r"which is not among the tokenizers"),
        ({"name": "../vqvae"}, r"which is not among the tokenizers"),
        ({"name": NAME, "channels": 32}, r"that does not fit \(.*channels"),
        ({"block": 4}, r"that does not fit \(.*block"),
        (3, r"that does not fit"),
        (None, r"that does not fit"),
    ],
)
def test_a_tokenizer_that_there_is_not_is_told_in_one_line(tokenizer, message, monkeypatch):
    installed(monkeypatch)
    data = configuration.to_json(LidarGritConfig()) | {"tokenizer": tokenizer}
    with pytest.raises(LidarGritError, match=message) as refusal:
        configuration.from_json(LidarGritConfig, data, "config.json")
    assert "\n" not in str(refusal.value)


def test_settings_of_any_tokenizer_are_changed_by_name(monkeypatch):
    config = LidarGritConfig(installed(monkeypatch)())
    assert configuration.override(config, ["tokenizer.levels=8"]).tokenizer.levels == 8
    with pytest.raises(ConfigError, match=r"'tokenizer\.num_codes', which"):
        configuration.override(config, ["tokenizer.num_codes=8"])

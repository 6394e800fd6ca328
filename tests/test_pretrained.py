"""The model in the package: it is there, it is small, it draws at once, and it is what its card says."""

import json
from pathlib import Path

import pytest
import torch

import lidargrit
from lidargrit import unproject
from lidargrit.cli import main
from lidargrit.errors import ConfigError
from lidargrit.evaluation.samples import read_samples
from lidargrit.files import read_tensors
from lidargrit.generators import Generator, load, locate
from lidargrit.recipes import load_recipe
from lidargrit.serving import finished_runs
from tiny_runs import the_one_line

FOLDER = Path(lidargrit.__file__).parent / "pretrained"


@pytest.fixture(scope="module")
def model():
    return load("pretrained")


def test_all_of_it_is_small_and_its_card_is_whole():
    assert sum(path.stat().st_size for path in FOLDER.iterdir()) < 16_000_000
    card = (FOLDER / "README.md").read_text(encoding="utf-8")
    for part in ("## How to sample", "## Data", "## Licence", "## Training", "## Scores", "## Where it fails"):
        assert part in card
    assert "| sliced_wasserstein |" in card


def test_it_is_what_its_recipe_makes(model):
    recipe = load_recipe("compact")
    assert model.config == recipe.model
    told = json.loads((FOLDER / "run.json").read_text(encoding="utf-8"))["recipe"]
    assert {stage: fit["scans"] for stage, fit in told["training"].items()} == {
        stage: fit.scans for stage, fit in recipe.training.items()
    }


def test_a_word_gives_scans(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["sample"]) == 0
    assert "16 scans lie in samples" in capsys.readouterr().out
    drawn = read_samples(tmp_path / "samples")
    images = drawn.batch(range(len(drawn)))
    assert images.range_m.shape == (16, 64, 256)
    assert 0.75 < images.return_mask.float().mean() < 0.95  # simulated streets: 0.86
    heights = torch.cat([unproject(images[index]).points_xyz_m[:, 2] for index in range(16)])
    ground = ((heights > -2.2) & (heights < -1.2)).float().mean()  # the sensor is 1.73 m above it
    assert ground > 0.35


def test_its_networks_compute_what_they_did_when_they_were_scored(model, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("LIDARGRIT_CACHE", str(tmp_path / "cache"))
    assert main(["evaluate", "pretrained", "simulated:8:test", "--json"]) == 0
    errors = json.loads(capsys.readouterr().out)["reconstruction"]
    assert errors["range_mae_m"] < 2.0
    assert errors["mask_accuracy"] > 0.9


def test_a_run_of_this_name_goes_first(model, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert locate("pretrained") == FOLDER
    (tmp_path / "pretrained").mkdir()
    assert locate("pretrained") == FOLDER  # an empty folder is no run
    load("pretrained").save(tmp_path / "pretrained")
    assert locate("pretrained") == Path("pretrained")
    assert locate("runs/mine") == Path("runs/mine")


def test_it_is_served_after_the_users_own(model, tmp_path):
    assert finished_runs(tmp_path) == [FOLDER]
    model.save(tmp_path / "zebra")
    assert finished_runs(tmp_path) == [tmp_path / "zebra", FOLDER]


def test_half_as_many_bytes_keep_what_networks_compute(model, tmp_path):
    model.save_pretrained(tmp_path / "whole")
    model.save_pretrained(tmp_path / "half", half=True)
    sizes = [(tmp_path / name / "model.safetensors").stat().st_size for name in ("whole", "half")]
    assert sizes[1] < 0.51 * sizes[0]
    weights, _ = read_tensors(tmp_path / "half" / "model.safetensors")
    assert {weight.dtype for weight in weights.values() if weight.is_floating_point()} == {torch.float16}
    again = Generator.from_pretrained(tmp_path / "half")
    assert {weight.dtype for weight in again.parameters()} == {torch.float32}
    for name, weight in again.state_dict().items():  # the package's are of 16 bits already
        assert torch.equal(weight, model.state_dict()[name])


def test_weights_beyond_16_bits_are_refused(tmp_path):
    model = load("pretrained")
    next(model.parameters()).data.view(-1)[0] = 1e6
    with pytest.raises(ConfigError, match=r"up to 1e\+06; wanted up to 65,504"):
        model.save(tmp_path / "half", half=True)


def test_notes_end_the_card(tmp_path, capsys):
    (tmp_path / "notes.md").write_text("## Where it fails\n\nEverywhere.\n", encoding="utf-8")
    assert main(["publish", "pretrained", str(tmp_path / "out"), "--notes", str(tmp_path / "notes.md"), "--half"]) == 0
    assert (tmp_path / "out" / "README.md").read_text(encoding="utf-8").endswith("## Where it fails\n\nEverywhere.\n")
    weights = "model.safetensors"
    assert (tmp_path / "out" / weights).read_bytes() == (FOLDER / weights).read_bytes()
    capsys.readouterr()
    assert main(["publish", "pretrained", str(tmp_path / "other"), "--notes", str(tmp_path / "none.md")]) == 2
    assert "none.md, which cannot be read" in the_one_line(capsys.readouterr().err, "publish")
    assert not (tmp_path / "other").exists()

"""The models in the package: they are there, they are small, they sample at once, and they are what their cards say."""

import json
import resource
import shutil
import time
from pathlib import Path

import pytest
import torch

import lidargrit
from lidargrit import project, simulate, unproject
from lidargrit.cli import main
from lidargrit.core.determinism import scan_seed
from lidargrit.core.errors import CheckpointError, ConfigError
from lidargrit.core.files import read_tensors
from lidargrit.data.formats.kitti_bin import KittiBin
from lidargrit.data.run_folder import locate
from lidargrit.data.sources.samples import read_samples
from lidargrit.generation.generator import Generator, load
from lidargrit.generation.presets import load_preset
from lidargrit.inference.segment import label_images, open_segmenter
from lidargrit.inference.segment.command import LabelScores
from lidargrit.scans.condition import Observed
from lidargrit.scans.types import RangeImage
from lidargrit.systems.lidargrit.system import LidarGrit
from lidargrit.training.compute import uniform_images
from lidargrit.viewer.serve import finished_runs
from tiny_runs import the_one_line

FOLDER = Path(lidargrit.__file__).parent / "pretrained"
WIDE = FOLDER.with_name("pretrained_wide")


@pytest.fixture(scope="module")
def model():
    return load("pretrained")


@pytest.mark.parametrize("folder", [FOLDER, WIDE])
def test_all_of_it_is_small_and_its_card_is_whole(folder):
    assert sum(path.stat().st_size for path in folder.rglob("*.safetensors")) < 14.8e6
    assert sum(path.stat().st_size for path in folder.rglob("*")) < 17.5e6
    card = (folder / "README.md").read_text(encoding="utf-8")
    for part in ("## How to sample", "## Data", "## Licence", "## Training", "## Scores", "## Where it fails"):
        assert part in card
    assert "| sliced_wasserstein |" in card


JOBS = ("sample", "complete", "raydrop")


def trained_as(name: str) -> tuple[list[str], dict[str, int]]:
    """Return the generators of a bundle by job, and the scans that each stage of its runs has seen at last."""
    generators, seen = [], {}
    for job in JOBS:
        preset = json.loads((locate(name, job) / "run.json").read_text(encoding="utf-8"))["preset"]
        generators.append(preset["generator"])
        seen |= {stage: fit["scans"] for stage, fit in preset["training"].items()}
    return generators, seen


def test_its_runs_are_what_their_presets_make():
    presets = [load_preset(name) for name in ("lidargrit_compact_pixels", "completion_compact", "raydrop_compact")]
    for job, preset in zip(JOBS, presets, strict=True):
        run = load("pretrained", job)
        assert (run.public_name(), run.config) == (preset.generator, preset.model)
    generators, seen = trained_as("pretrained")
    assert generators == [preset.generator for preset in presets]
    seen["transformer"] += 18_000 + 36_000 + 30_000  # before they were trained further, as the card says
    seen["pixels"] += 17_000 + 9000 + 16_000
    assert seen.pop("raydrop") == 3000  # on streets of version 2, after its preset's 4,000 on those of version 1
    assert seen.pop("completion") == 4000  # the same, after its preset's 22,000
    assert seen == {stage: fit.scans for stage, fit in presets[0].training.items()}


def test_those_of_the_wide_one_are_what_their_presets_make():
    presets = [load_preset(name) for name in ("lidargrit_wide_pixels", "completion_wide", "raydrop_compact")]
    for job, preset in zip(JOBS, presets, strict=True):
        run = load("pretrained_wide", job)
        assert (run.public_name(), run.config) == (preset.generator, preset.model)
        assert run.sensor.same_rays(presets[0].data.load_sensor())
        assert (run.sensor.height, run.sensor.width) == (64, 1024)
    generators, seen = trained_as("pretrained_wide")
    assert generators == [preset.generator for preset in presets]
    seen["transformer"] += 3600 + 6000  # before they were trained further, as the card says
    seen["pixels"] += 9000 + 1600
    assert seen.pop("raydrop") == 2500  # of 1,024 columns, which are as much to learn from as 10,000 of 256
    assert seen == {stage: fit.scans for preset in presets[:2] for stage, fit in preset.training.items()}


def test_its_segmenter_labels_streets_that_it_did_not_learn_from():
    segmenter, preset = open_segmenter("pretrained", "cpu"), load_preset("segmenter_compact")
    assert (segmenter.public_name(), segmenter.config) == (preset.generator, preset.model)
    assert (FOLDER / "segmenter" / "model.safetensors").stat().st_size < 1.5e6
    scores = LabelScores()
    for seed in (2_000_000, 2_000_001):
        image = RangeImage.stack([project(simulate(seed=seed), segmenter.sensor)])
        scores.add(label_images(segmenter, image).label.flatten(), image.label.flatten())
    assert scores.mean() > 0.4
    assert scores.intersection_over_union()["road"] > 0.8
    with pytest.raises(ConfigError, match=r"^got --model pretrained_wide, of a generator 'lidargrit', which labels no"):
        open_segmenter("pretrained_wide")


def test_what_it_completes_is_completed_by_its_runs(model):
    one = RangeImage.stack([project(simulate(seed=2_000_000), model.sensor)])
    observed = torch.zeros_like(one.return_mask)
    observed[:, ::4] = True
    for job, known in (("complete", Observed.of_pixels(one, observed)), ("raydrop", Observed.of_surfaces(one))):
        done, by_run = model.complete(known, [0]), load("pretrained", job).complete(known, [0])
        assert torch.equal(done.range_m, by_run.range_m)


def test_a_word_gives_scans(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(LidarGrit, "own_batches", (4, 4))  # as many as are wanted
    assert main(["sample", "pretrained", "first", "-n", "4"]) == 0
    assert "done: 4 scans in first" in capsys.readouterr().out
    drawn = read_samples(tmp_path / "first")
    images = drawn.batch(range(len(drawn)))
    assert images.range_m.shape == (4, 64, 256)
    assert 0.75 < images.return_mask.float().mean() < 0.95  # simulated streets: 0.86
    heights = torch.cat([unproject(images[index]).points_xyz_m[:, 2] for index in range(4)])
    ground = ((heights > -2.2) & (heights < -1.2)).float().mean()  # the sensor is 1.73 m above it
    assert ground > 0.35


def test_its_drives_begin_with_a_scan_of_its_own_and_keep_to_the_car_s_shadow(tmp_path, model, monkeypatch):
    monkeypatch.setattr(LidarGrit, "own_batches", (1, 1))  # else eight scans are computed for one
    assert load("pretrained", "drive").config == load_preset("forecaster_compact").model
    assert main(["sample", "pretrained", str(tmp_path / "drive"), "-n", "1", "--frames", "2"]) == 0
    first, second = (
        project(KittiBin.read(tmp_path / f"drive/sequences/00/velodyne/{number:06d}.bin"), model.sensor)
        for number in range(2)
    )
    assert torch.equal(first.return_mask, model.sample([scan_seed(0, 0)])[0].return_mask)
    both = first.return_mask & second.return_mask
    assert float((first.range_m - second.range_m)[both].abs().median()) < 1  # a metre on
    assert float((first.return_mask == second.return_mask)[50:].float().mean()) > 0.8  # rows with the own car


def test_its_networks_compute_what_they_did_when_streets_3_came(model, capsys):
    assert main(["likelihood", "simulated:8:test", "--json"]) == 0
    errors = json.loads(capsys.readouterr().out)["reconstruction"]
    assert errors["range_mae_m"] == pytest.approx(1.094, rel=0.02)  # of streets 1, from which it learned, 1.128
    assert errors["mask_accuracy"] == pytest.approx(0.925, abs=0.004)
    one = RangeImage.stack([project(simulate(seed=0), model.sensor)])
    bits = model.bits(one)
    found = {name: value.item() for name, value in bits.per_scan().items()}
    pixels, returns = 64 * 256, int(one.return_mask.sum())
    assert found["tokens"] / pixels == pytest.approx(0.0889, abs=0.001)  # 3.94 nats a token; untrained 6.9
    assert found["mask"] / pixels == pytest.approx(0.2999, abs=0.003)
    assert found["range"] / returns == pytest.approx(5.526, abs=0.02)


def test_the_wide_one_computes_what_it_did_when_streets_3_came():
    wide = load("pretrained_wide")
    one = RangeImage.stack([project(simulate(seed=0), wide.sensor)])
    found = {name: value.item() for name, value in wide.bits(one).per_scan().items()}
    pixels, returns = 64 * 1024, int(one.return_mask.sum())
    assert found["tokens"] / pixels == pytest.approx(0.0886, abs=0.001)
    assert found["mask"] / pixels == pytest.approx(0.2803, abs=0.003)
    assert found["range"] / returns == pytest.approx(4.932, abs=0.01)
    decoded = wide.reconstruct(one)  # a new scan takes ten times as long, and all but its tokens come the same way
    assert decoded.range_m.shape == (1, 64, 1024)
    assert 0.75 < decoded.return_mask.float().mean() < 0.95  # simulated streets: 0.86


def test_what_a_user_calls_so_goes_first(model, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert locate("pretrained") == locate(Path("pretrained")) == locate("pretrained/lidargrit") == FOLDER / "lidargrit"
    assert locate("pretrained", "complete") == locate("pretrained/completion") == FOLDER / "completion"
    assert locate("pretrained_wide", "raydrop") == WIDE / "raydrop"
    (tmp_path / "pretrained").mkdir()
    assert locate("pretrained") == FOLDER / "lidargrit"  # an empty folder is nothing
    (tmp_path / "pretrained" / "samples.json").write_text("{}")
    assert locate("pretrained") == Path("pretrained")
    assert locate("pretrained/completion") == Path("pretrained/completion")
    assert locate("runs/mine") == Path("runs/mine")
    with pytest.raises(CheckpointError, match="which holds no finished model"):
        load("pretrained")


def test_every_verb_that_takes_a_run_takes_the_word(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(LidarGrit, "own_batches", (1, 1))  # else eight scans are computed for one
    few = ["--reference", "simulated:2:test", "-n", "2", "--metrics", "bev_jsd"]
    assert main(["compare", "table", "pretrained", *few]) == 0
    words = ["data.train=simulated:2:train", "data.val=simulated:1:val", "training.tokenizer.start=frozen:pretrained"]
    words += [f"training.transformer.{setting}" for setting in ("scans=2", "batch_size=2", "warmup_scans=0")]
    words.append("model.transformer.layers=1")
    assert main(["train", "lidargrit_compact", "run", "--set", *words]) == 0
    assert main(["publish", "run", "to_share"]) == 0
    assert (
        json.loads((tmp_path / "to_share" / "run.json").read_text())["preset"]["training"]["tokenizer"]["start"] == ""
    )
    known = [
        json.loads((run_folder / "trained_on.json").read_text())["fingerprints"] for run_folder in (FOLDER, Path("run"))
    ]
    assert len(known[1]) == len({*known[0]} | {*known[1]}) > len(known[0]) - 1
    capsys.readouterr()


def test_they_are_served_after_the_users_own(model, tmp_path, monkeypatch):
    assert finished_runs(tmp_path, print) == [FOLDER, WIDE]
    model.save(tmp_path / "zebra")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pretrained").mkdir()
    (tmp_path / "pretrained" / "samples.json").write_text("{}")  # what a user calls so is no run
    assert finished_runs(tmp_path, print) == [tmp_path / "zebra", FOLDER, WIDE]


def test_half_as_many_bytes_keep_what_networks_compute(model, tmp_path):
    torch.manual_seed(0)
    whole = type(model)(model.config, model.sensor).eval()  # not the model's own: they are rounded already
    images = uniform_images(model.sensor, 2)
    wanted = whole.tokenizer.latents(images)
    whole.save_pretrained(tmp_path / "whole", bits=32)
    whole.save_pretrained(tmp_path / "half", bits=16)
    sizes = [(tmp_path / name / "model.safetensors").stat().st_size for name in ("whole", "half")]
    assert sizes[1] < 0.52 * sizes[0]
    weights, _ = read_tensors(tmp_path / "half" / "model.safetensors")
    halved = {name for name, weight in weights.items() if weight.dtype == torch.float16}
    assert halved == dict(whole.named_parameters()).keys()
    again = Generator.from_pretrained(tmp_path / "half")
    assert {weight.dtype for weight in again.parameters()} == {torch.float32}
    torch.testing.assert_close(again.tokenizer.latents(images), wanted, atol=5e-3, rtol=5e-3)


def test_weights_beyond_16_bits_are_refused_before_anything_is_written(tmp_path, capsys):
    model = load("pretrained")
    next(model.parameters()).data.view(-1)[0] = 1e6
    model.save(tmp_path / "run")
    assert main(["publish", str(tmp_path / "run"), str(tmp_path / "out"), "--bits", "16"]) == 2
    assert "of up to 1e+06; wanted at most 65,504" in the_one_line(capsys.readouterr().err, "publish")
    assert not (tmp_path / "out").exists()


def test_notes_end_the_card(tmp_path, capsys):
    (tmp_path / "notes.md").write_text("## Where it fails\n\nEverywhere.\n", encoding="utf-8")
    words = ["publish", "pretrained", str(tmp_path / "out"), "--notes", str(tmp_path / "notes.md"), "--bits", "8"]
    assert main(words) == 0
    assert (tmp_path / "out" / "README.md").read_text(encoding="utf-8").endswith("## Where it fails\n\nEverywhere.\n")
    weights = "model.safetensors"
    assert (tmp_path / "out" / weights).read_bytes() == (FOLDER / "lidargrit" / weights).read_bytes()
    capsys.readouterr()
    assert main(["publish", "pretrained", str(tmp_path / "other"), "--notes", str(tmp_path / "none.md")]) == 2
    assert "none.md, which cannot be read" in the_one_line(capsys.readouterr().err, "publish")
    assert not (tmp_path / "other").exists()


def _streaming(images: RangeImage, folder: Path, removed: str):
    """Return a method that yields two images, before the second of which something is removed from a folder."""

    def stream(*_: object):
        yield images
        if removed:
            (folder / removed).unlink()
        else:
            shutil.rmtree(folder)
        yield images

    return stream


@pytest.mark.parametrize("removed", ["", "samples.json", "00000000.npz"])
def test_samples_that_are_removed_meanwhile_are_an_error(model, monkeypatch, tmp_path, capsys, removed):
    range_m = torch.zeros(model.sensor.height, model.sensor.width)
    empty = RangeImage(range_m, range_m > 0, model.sensor)
    monkeypatch.setattr(Generator, "stream", _streaming(empty, tmp_path / "out", removed))
    assert main(["sample", "pretrained", str(tmp_path / "out"), "-n", "2"]) == 2
    line = the_one_line(capsys.readouterr().err, "sample")
    assert "out, from which files were removed meanwhile; wanted" in line
    assert (tmp_path / "out").exists() == bool(removed)


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        (("transformer", "layers"), 1_000_000),
        (("transformer", "width"), 4 * 10**6),
        (("tokenizer", "channel_multipliers"), [1_000_000] * 4),
        (("tokenizer", "channel_multipliers"), [1] * 100_000),
        (("tokenizer", "residual_blocks"), 1_000_000),
        (("tokenizer", "channels"), 32 * 10**6),
        (("tokenizer", "num_codes"), 10**9),
    ],
)
def test_settings_of_a_huge_network_are_refused_at_once(model, tmp_path, capsys, setting, value):
    folder = shutil.copytree(FOLDER / "lidargrit", tmp_path / "run")
    about = json.loads((folder / "config.json").read_text())
    about["config"][setting[0]][setting[1]] = value
    (folder / "config.json").write_text(json.dumps(about))
    begun, before = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert main(["sample", str(folder), str(tmp_path / "out"), "-n", "1"]) == 2
    assert time.process_time() - begun < 5  # seconds of the processor; half a second on an idle laptop
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500_000  # kilobytes
    the_one_line(capsys.readouterr().err, "sample")
    assert not (tmp_path / "out").exists()

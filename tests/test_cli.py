"""Every verb from end to end, as a user types it, on a model of the smallest size."""

import contextlib
import json
import os
import re
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import lidargrit
from dataset_examples import write_example
from lidargrit.cli import build_parser, main
from lidargrit.core import discovery
from lidargrit.data.formats import read_scan as read_bin
from lidargrit.data.sources.samples import read_samples
from lidargrit.evaluation.evaluate import EvalConfig
from lidargrit.evaluation.scorecard import format_value
from lidargrit.generation.presets import load_preset
from tiny_runs import MODEL, the_one_line

TINY = [
    "data.train=[simulated:6:train]",
    "data.val=[simulated:2:val]",
    *MODEL,
    "training.tokenizer.scans=8",
    "training.transformer.scans=8",
]
ONE_METRIC = ("lidargrit.viewer.demo.EvalConfig", partial(EvalConfig, metrics=("bev_jsd",)))
PIXELS = ["training.pixels.scans=2", "model.pixels.mask_width=4", "model.pixels.range_width=4", "model.pixels.blocks=1"]


@pytest.fixture
def typed(capsys):
    """Return a function that runs a command and returns what it prints, having checked that it went well."""

    def run(*words: object) -> str:
        capsys.readouterr()
        code = main([str(word) for word in words])
        captured = capsys.readouterr()
        assert code == 0, captured.err
        return captured.out

    return run


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory) -> Path:
    """Return a finished run, in a folder whose name has a space."""
    folder = tmp_path_factory.mktemp("runs") / "my run"
    assert main(["train", "lidargrit_demo", str(folder), "--set", *TINY]) == 0
    return folder


@pytest.fixture(scope="module")
def samples(run_folder) -> Path:
    folder = run_folder.parent / "samples"
    assert main(["sample", str(run_folder), str(folder), "-n", "3"]) == 0
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_train_leaves_a_run_that_says_what_it_is(run_folder):
    boards = {path for path in contents(run_folder) if "events.out.tfevents" in path}  # one of each stage
    assert {path.split("/")[0] for path in boards} == {"tokenizer", "transformer"}
    assert set(contents(run_folder)) - boards == {
        "run.json",
        "trained_on.json",
        "config.json",
        "model.safetensors",
        *(
            f"{stage}/{file}"
            for stage in ("tokenizer", "transformer")
            for file in ("checkpoint.safetensors", "log.jsonl")
        ),
    }
    about = json.loads((run_folder / "run.json").read_text())
    assert about["preset"]["data"]["train"] == ["simulated:6:train"]
    assert about["preset"]["training"]["tokenizer"]["scans"] == 8
    assert about["lidargrit"] == lidargrit.__version__
    assert about["torch"] == torch.__version__
    log = [json.loads(line) for line in (run_folder / "tokenizer" / "log.jsonl").read_text().splitlines()]
    assert log[-1]["scans_seen"] == 8
    assert log[-1]["split"] == "val"
    assert np.isfinite(log[-1]["loss"])


def test_the_same_train_command_again_changes_nothing(run_folder, typed):
    before = contents(run_folder)
    done = f"done: the model lies in {run_folder}; try it with: lidargrit sample {run_folder} samples -n 16"
    assert done in typed("train", "lidargrit_demo", run_folder, "--set", *TINY)
    assert contents(run_folder) == before


def test_settings_may_come_before_the_names(run_folder, typed):
    before = contents(run_folder)
    assert "done" in typed("train", "--set", *TINY, "--", "lidargrit_demo", run_folder)
    assert contents(run_folder) == before


def test_dry_run_tells_the_plan_and_writes_nothing(tmp_path, typed):
    output = typed("train", "lidargrit_demo", tmp_path / "none", "--dry-run", "--set", *TINY)
    for line in ("training.tokenizer.scans = 8", "range images of 64x64, 0.", "transformer: ", "8 scans in batches of"):
        assert line in output
    assert not (tmp_path / "none").exists()
    (tmp_path / "mine.txt").touch()
    assert main(["train", "lidargrit_demo", str(tmp_path), "--dry-run"]) == 2, "as the training would"


@pytest.mark.parametrize("data", ["data.train=gone/scans", "data.val=simulated:2:val,gone/scans"])
def test_dry_run_fails_where_the_training_would_for_lack_of_scans(data, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    settings = ["data.train=simulated:2", "data.val=simulated:2", data]
    assert main(["train", "marginal", "none", "--dry-run", "--set", *settings]) == 2
    captured = capsys.readouterr()
    assert "data.columns = " in captured.out, "the plan is told all the same"
    assert the_one_line(captured.err, "train").startswith("lidargrit train: got gone/scans, which does not exist; ")
    assert not list(tmp_path.iterdir())


def test_dry_run_finds_prepared_scans_of_another_sensor(tmp_path, capsys):
    words = ["-o", str(tmp_path / "prepared"), "--set", "data.columns=64", "--workers", "1"]
    assert main(["prepare", "simulated:2:train", *words]) == 0
    settings = [f"data.train={tmp_path / 'prepared'}", "data.val=simulated:2", "data.columns=128"]
    capsys.readouterr()
    assert main(["train", "marginal", str(tmp_path / "none"), "--dry-run", "--set", *settings]) == 2
    assert "(64x64); wanted the rays of " in the_one_line(capsys.readouterr().err, "train")


def told_at_once(preset, without=()):
    return dict.fromkeys(preset.training, 10**18)


@pytest.mark.parametrize("preset", discovery.names("presets"))
def test_every_preset_has_a_plan(preset, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sys.modules["lidargrit.training.plan"], "training_flops", told_at_once)  # else seconds each
    monkeypatch.chdir(tmp_path)
    name, root = load_preset(preset).data.train[0].split(":")[:2]
    is_simulated = name.startswith("simulated")
    assert main(["train", preset, "none", "--dry-run"]) == (0 if is_simulated else 2)
    captured = capsys.readouterr()
    assert (root in captured.err) is not is_simulated, "where data sets are looked for"
    assert "published: " in captured.out
    assert (" parameters, " in captured.out) == bool(load_preset(preset).training)


def test_a_plan_tells_which_stages_are_taken_and_not_trained(tmp_path, capsys, monkeypatch):
    words = ["train", "lidargrit_compact_pixels", str(tmp_path / "none"), "--dry-run"]
    taking = ["--set", *(f"training.{stage}.start=frozen:pretrained" for stage in ("tokenizer", "transformer"))]
    assert main([*words, "--json", *taking]) == 0
    stages = {stage["name"]: stage for stage in json.loads(capsys.readouterr().out)["stages"]}
    assert {name for name, stage in stages.items() if not stage["taken_from"]} == {"pixels"}
    assert stages["transformer"]["taken_from"] == "pretrained"
    assert stages["transformer"]["flops"] == 0 < stages["pixels"]["flops"]
    monkeypatch.setattr(sys.modules["lidargrit.training.plan"], "training_flops", told_at_once)
    assert main([*words, *taking, "training.pixels.start=pretrained"]) == 0
    text = capsys.readouterr().out
    assert "transformer: 4,539,136 parameters, taken from pretrained and not trained" in text
    assert "pixels: 1,019,023 parameters, 58,000 scans" in text
    assert main([*words, *taking, "training.pixels.start=pretrained", "model.pixels.coarsest_cell=8"]) == 2
    assert "whose pixels is another (model.pixels.coarsest_cell=64)" in the_one_line(capsys.readouterr().err, "train")


def test_sample_writes_one_file_a_seed_and_draws_no_seed_twice(run_folder, samples, typed, monkeypatch):
    before = contents(samples)
    assert set(before) == {"samples.json", "trained_on.json", "00000000.npz", "00000001.npz", "00000002.npz"}
    with np.load(samples / "00000000.npz", allow_pickle=False) as opened:
        assert opened["range_m"].shape == (64, 64)
        assert opened["range_m"].dtype == np.float32

    def draws_nothing(*_):
        raise AssertionError("drew what was there")

    monkeypatch.setattr("lidargrit.systems.lidargrit.system.LidarGrit.sample", draws_nothing)
    assert "done: 3 scans in" in typed("sample", run_folder, samples, "-n", 3)
    assert contents(samples) == before


def test_a_seed_gives_the_same_sample_whatever_is_drawn_beside_it(run_folder, samples, tmp_path, typed):
    typed("sample", run_folder, tmp_path / "later", "--seed", 1, "-n", 3)
    earlier, later = read_samples(samples), read_samples(tmp_path / "later")
    assert later.provenance.names[:2] == earlier.provenance.names[1:]
    assert later.provenance.names[2].endswith("/sample 00000003")
    assert torch.allclose(later.batch([0, 1]).range_m, earlier.batch([1, 2]).range_m, atol=1e-3)
    typed("sample", run_folder, tmp_path / "later", "--seed", 0, "-n", 5)
    assert len(read_samples(tmp_path / "later")) == 5
    names = read_samples(tmp_path / "later", 2).provenance.names
    assert [name[-1] for name in names] == ["0", "2"], "evenly spaced"


def test_sampling_options_reach_the_model(run_folder, tmp_path, typed):
    settings = ("--set", "sampling.temperature=0", "--set", "sampling.mask=threshold")
    typed("sample", run_folder, tmp_path, "-n", 2, *settings, "--device", "cpu")
    images = read_samples(tmp_path).batch([0, 1])
    assert torch.equal(images.range_m[0], images.range_m[1]), "the likeliest tokens do not depend on the seed"
    manifest = json.loads((tmp_path / "samples.json").read_text())
    assert manifest["generator"] == "lidargrit"
    assert manifest["sampling"] == {
        "temperature": 0.0,
        "top_k": 0,
        "top_p": 1.0,
        "guidance": 0.0,
        "mask": "threshold",
        "range_temperature": 0.0,
        "surface_temperature": 0.0,
        "mask_temperature": 0.0,
        "batch_size": 0,
        "range_noise": 0.7,
        "mask_correlation": 2.0,
        "weights": "fp32",
        "decoder": "fp32",
    }


def test_evaluate_prints_a_table_and_writes_json(samples, tmp_path, typed):
    output = typed("evaluate", samples, "simulated:3:test", "--json", tmp_path / "deep" / "scores.json")
    words, _, numbers = output.rpartition("\n\n")
    assert "No verdict: 3 scans in each set are too few" in words
    aside = " is not 0 for equal sets: ", "simulated streets: "
    *output, done = (line for line in numbers.splitlines() if not any(each in line for each in aside))
    assert done == f"done: scores in {tmp_path / 'deep' / 'scores.json'}"
    assert " ".join(output[0].split()) == "metric variant score 95 % interval real against real better scans"
    scores = json.loads((tmp_path / "deep" / "scores.json").read_text())
    assert scores["reference"] == "simulated:3:test"
    assert [score["variant"] for score in scores["scores"]] == [line.split()[1] for line in output[1:]]
    for score, line in zip(scores["scores"], output[1:], strict=True):
        assert score["num_generated"] == score["num_reference"] == 3
        assert f" {format_value(score['value'])} " in line
        assert "lower" in line


def test_evaluate_one_variant_of_some_scans_twice_gives_the_same(samples, typed):
    words = ("evaluate", samples, "simulated:3:test", "--variant", "textbook", "-n", 2, "--seed", 5)
    output = typed(*words)
    assert any(line.split()[-3:] == ["2", "v", "2"] for line in output.splitlines())
    assert typed(*words) == output


def test_evaluate_real_against_real(typed):
    assert "3 v 3" in typed(
        "evaluate", "simulated:3:train", "simulated:3:test", "--set", "data.projection_variant=reference"
    )


def test_view_draws_runs_samples_and_scans(run_folder, samples, tmp_path, typed):
    assert "done: look at" in typed("view", "simulated:2:val", run_folder, samples, "-o", tmp_path / "all.png", "-n", 1)
    with Image.open(tmp_path / "all.png") as picture:
        picture.verify()
        assert picture.format == "PNG"
        four_rows = picture.height
    typed("view", run_folder, "-o", tmp_path / "run.png", "-n", 1)
    typed("view", samples, run_folder, "-o", tmp_path / "run.html", "-n", 9)
    page = (tmp_path / "run.html").read_text(encoding="utf-8")
    assert page.count(": reconstructed") >= 1
    assert page.count('"generated": true') == 3, "samples, their reconstructions and new ones: none was measured"
    assert page.count('"seed ') == 9
    with Image.open(tmp_path / "run.png") as picture:
        assert picture.height < four_rows


def test_processes_share_the_seeds(run_folder, tmp_path, typed):
    for rank in (1, 0):
        assert "done: 2 scans" in typed("sample", run_folder, tmp_path, "-n", 4, "--rank", rank, "--world-size", 2)
        assert len(read_samples(tmp_path)) == (4 if rank == 0 else 2)
    assert {path.stem for path in tmp_path.glob("*.npz")} == {f"{seed:08d}" for seed in range(4)}


def test_list_names_everything_there_is(typed):
    output = typed("list")
    for kind in ("datasets", "formats", "sensors", "tokenizers", "generators", "metrics", "presets"):
        in_full = typed("list", kind)
        assert in_full.splitlines()[0] == kind
        for name in discovery.names(kind):
            assert f"  {name} " in output
            assert f"  {name} " in in_full
    assert "sample --set sampling.NAME: temperature=1.0, top_k=0, top_p=1.0, guidance=0.0" in typed(
        "list", "generators"
    )
    assert "licence: " in typed("list", "datasets")
    assert "      higher is better: no\n      variants: " in typed("list", "metrics")
    assert "      rows: 64\n      columns: " in typed("list", "sensors")
    assert "  lidargrit-kitti-360 " in typed("list", "protocols")
    assert "  lidargen " in typed("list", "sample-formats")


def test_doctor_tells_versions_and_room(typed):
    output = typed("doctor")
    assert lidargrit.__version__ in output
    assert torch.__version__ in output
    assert os.environ["LIDARGRIT_CACHE"] in output


def test_demo_writes_its_page_and_writes_it_again(tmp_path, typed, monkeypatch):
    monkeypatch.setattr(*ONE_METRIC)
    monkeypatch.setattr("lidargrit.viewer.demo.measure", lambda _preset: [])  # seconds, for an estimate
    monkeypatch.setattr("lidargrit.viewer._matplotlib._DOTS_PER_INCH", 20)
    monkeypatch.setattr("lidargrit.viewer.demo._NUM_SAMPLES", 11)  # as many as its pictures show
    words = ("demo", "--out", tmp_path / "demo", "--set", *TINY, *PIXELS)
    assert f"done: look at {tmp_path / 'demo'}" in typed(*words)
    before = contents(tmp_path / "demo")
    for name in (
        "demo.html",
        "timings.json",
        "scans_reconstructed_generated.png",
        "generated.png",
        "samples/00000010.npz",
        "model.safetensors",
    ):
        assert name in before
    evaluation = json.loads(before["evaluation.json"])
    assert evaluation["reconstruction_on_val"]["num_scans"] == 2
    assert evaluation["generated_against_val"]
    typed(*words)
    again = contents(tmp_path / "demo")
    of_time = rb'"seconds": [0-9.]+|(?<="left_out": \[\],\n    )"sha256": "[0-9a-f]+"'  # how long it took, and its hash
    for content in (before, again):
        content["evaluation.json"] = re.sub(of_time, b"", content["evaluation.json"])
    assert again == before


def test_python_and_the_command_line_do_the_same(run_folder, samples):
    drawn = lidargrit.load(run_folder).sample([0, 1, 2])
    assert torch.allclose(drawn.range_m, read_samples(samples).batch([0, 1, 2]).range_m, atol=1e-3)
    card = lidargrit.evaluate(str(samples), "simulated:3:test", metrics=["sliced_wasserstein"])
    assert [score.result.variant for score in card.scores] == ["reference", "textbook"]


def test_load_scan_reads_what_the_example_wrote(tmp_path):
    write_example("folder", tmp_path, 1)
    assert len(lidargrit.load_scan(tmp_path / "000000.bin")) == len(read_bin(tmp_path / "000000.bin"))


def python(program: str, *words: object, **options) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", program, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, **options)


def test_help_of_every_verb_loads_no_torch_and_opens_with_examples():
    program = """
import contextlib, sys
from lidargrit.cli import build_parser, main
for words in ([], *([word] for word in sys.argv[1:])):
    with contextlib.suppress(SystemExit):
        main([*words, "--help"])
main([])
main(["list"])
sys.exit(" ".join(name for name in ("torch", "numpy", "matplotlib", "rich") if name in sys.modules))
"""
    verbs = [name.replace("_", "-") for name in discovery.names("cli")]
    done = python(program, *verbs)
    assert (done.returncode, done.stderr) == (1, "\n"), done.stderr
    assert done.stdout.count("examples:\n  lidargrit ") == len(verbs) + 2


def test_the_version_is_told():
    done = subprocess.run([sys.executable, "-m", "lidargrit", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == f"lidargrit {lidargrit.__version__}"


@pytest.mark.parametrize("words", [["list"], ["--print-completion", "bash"], []])
def test_a_reader_that_has_seen_enough_is_no_error(words):
    reading, writing = os.pipe()
    os.close(reading)
    with contextlib.closing(os.fdopen(writing, "w")) as pipe:
        command = [sys.executable, "-m", "lidargrit", *words]
        done = subprocess.run(command, stdout=pipe, stderr=subprocess.PIPE, text=True, timeout=60, check=False)
    slow = [f"lidargrit {words[0]} loads its libraries"] if words else []  # told after two seconds
    assert done.returncode == 0
    assert done.stderr.splitlines() in ([], slow)


def test_every_option_says_what_it_is():
    for verb in build_parser().verbs():
        for action in verb._actions:
            if action.dest == "debug":  # which the help of all verbs together explains
                continue
            about = (verb.prog, action.dest, action.help)
            assert action.dest != "device" or action.default == "", "every verb chooses the device by itself"
            assert action.help, about
            assert len(action.help.split()) >= 3, about
            assert not re.match(r"(of|for|that|as|in all|likewise|evenly|see)\b", action.help), about
            assert len(verb.format_help()) > 200, about

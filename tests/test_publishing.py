"""A run → a folder that can be shared: the hub's file names, a card that keeps to the facts, no path of the user's."""

import errno
import json
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from PIL import Image

import lidargrit
from dataset_examples import write_example
from lidargrit.cli import main
from lidargrit.core import configuration
from lidargrit.core.files import sha256_of_json, write_json
from lidargrit.data.datasets import data_set_and_split, open_dataset
from lidargrit.data.datasets import folder as folder_of_scans
from lidargrit.data.datasets.shared import files as _files
from lidargrit.data.images import Provenance
from lidargrit.data.sources import data_set_of
from lidargrit.evaluation.scorecard import Scorecard
from lidargrit.generation.generator import Generator
from lidargrit.generation.presets import load_preset
from lidargrit.publishing import publish
from lidargrit.publishing.card import model_card
from lidargrit.systems.marginal.system import Marginal
from lidargrit.training.taken_stages import taken_facts
from tiny_runs import MODEL, SHORT, contents, the_one_line


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Return a finished run on a user's own drives, with samples and their scores beside it."""
    folder = tmp_path_factory.mktemp("private_place")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LIDARGRIT_CACHE", str(folder / "cache"))
        write_example("kitti_odometry", folder / "data", 4)
        sources = [f"data.train=[kitti_odometry:{folder / 'data'}:train]", f"data.val=[{folder / 'data'}:08]"]
        assert main(["train", "lidargrit_demo", str(folder / "run"), "--set", *MODEL, *SHORT, *sources]) == 0
        assert main(["sample", str(folder / "run"), str(folder / "samples"), "-n", "3"]) == 0
        words = [
            "--metrics",
            "sliced_wasserstein",
            "bev_jsd",
            "--intervals",
            "0",
            "--json",
            str(folder / "scores.json"),
        ]
        assert main(["evaluate", str(folder / "samples"), f"{folder / 'data'}:00", *words]) == 0
    return folder / "run"


def head_of(card):
    _, head, body = card.split("---\n", 2)
    return yaml.safe_load(head), body


def test_what_is_published_is_a_run_without_the_users_places(run, tmp_path, capsys):
    public = tmp_path / "public"
    assert main(["publish", str(run), str(public), "--scores", str(run.parent / "scores.json")]) == 0
    assert "to upload: hf upload USER/NAME" in capsys.readouterr().out
    files = contents(public)
    assert set(files) == {"README.md", "config.json", "model.safetensors", "run.json", "trained_on.json"}
    assert all(b"private_place" not in of and b"/tmp" not in of for of in files.values())
    assert (public / "model.safetensors").read_bytes() == (run / "model.safetensors").read_bytes()
    about = json.loads(files["run.json"])
    assert about["preset"]["data"]["train"] == ["kitti_odometry::train"]
    assert about["preset"]["training"]["transformer"]["scans"] == 8
    model = Generator.from_pretrained(public)
    assert torch.equal(model.sample([3]).range_m, lidargrit.load(run).sample([3]).range_m)
    assert main(["sample", str(public), str(tmp_path / "drawn"), "-n", "1"]) == 0
    assert json.loads((tmp_path / "drawn" / "samples.json").read_text())["projection_variant"] == "exact"
    again = tmp_path / "again"
    assert main(["publish", str(public), str(again), "--scores", str(run.parent / "scores.json")]) == 0
    assert contents(again) == files
    assert main(["train", "lidargrit_demo", str(public), "--set", *MODEL]) == 2
    assert "whose weights were published" in capsys.readouterr().err


def test_recordings_that_are_paths_are_not_published(run, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(run, copy)
    about = json.loads((copy / "trained_on.json").read_text())
    about["recordings"] = ["/home/anna/secret/drive.pcap", "#0123456789ab/secret", "drive_9005"]
    (copy / "trained_on.json").write_text(json.dumps(about))
    publish(copy, tmp_path / "public")
    assert json.loads((tmp_path / "public" / "trained_on.json").read_text())["recordings"] == ["drive_9005"]
    image = tmp_path / "secret_place" / "drive" / "0.png"
    image.parent.mkdir(parents=True)
    Image.fromarray(np.full((64, 870), 5000, np.uint16)).save(image)
    name = open_dataset(f"range_images:{tmp_path / 'secret_place'}").recording(0)
    assert name.startswith("#")
    assert "secret_place" not in name


def test_the_card_tells_the_facts(run, tmp_path):
    told = json.loads((run.parent / "scores.json").read_text())
    told["inputs"]["samples"]["source"], told["warnings"] = "clients/acme corp/smp", ["clients/acme corp/smp overlap"]
    write_json(tmp_path / "told.json", Scorecard.from_json(told).to_json())
    assert main(["publish", str(run), str(tmp_path / "public"), "--scores", str(tmp_path / "told.json")]) == 0
    head, body = head_of((tmp_path / "public" / "README.md").read_text())
    assert head == {
        "library_name": "lidargrit",
        "pipeline_tag": "unconditional-image-generation",
        "license": "cc-by-nc-sa-3.0",
        "tags": ["lidar", "point-cloud", "range-image", "lidargrit"],
    }
    scores = json.loads((run.parent / "scores.json").read_text())["scores"]
    for fact in (
        "# lidargrit for hdl64e_kitti_odometry",
        "range images of 64x64 pixels, 0.9 to 120 m",
        "| train | kitti_odometry | train | CC BY-NC-SA 3.0 (non-commercial) |",
        "| val | kitti_odometry | 08 | CC BY-NC-SA 3.0 (non-commercial) |",
        "Splits of kitti_odometry are those of ",
        "treat the weights as non-commercial too",
        "Preset: LidarGRIT, demo: the small model for a few minutes.",
        "| tokenizer | 4 | 4 | 0.0015 |",
        "| transformer | 8 | 8 | 0.001 |",
        f"lidargrit {lidargrit.__version__}, commit ",
        "By the protocol `exact`, against 2 scans of kitti_odometry 00.",
        "Generator.from_pretrained(",
        "- warning: the samples overlap",
    ):
        assert fact in body, fact
    assert sum(
        line.startswith(f"| {score['metric']} | {score['variant']} |") for score in scores for line in body.splitlines()
    ) == len(scores)


@pytest.mark.parametrize("source", ["samples", "s"])
def test_a_short_name_of_samples_does_not_change_words_in_sentences(run, tmp_path, source):
    told = json.loads((run.parent / "scores.json").read_text())
    told["inputs"]["samples"]["source"], told["warnings"] = source, [f"{source} and the reference overlap"]
    told["deviations"] = ["the samples are projected by 'exact', not by 'reference'"]
    write_json(tmp_path / "told.json", Scorecard.from_json(told).to_json())
    card = publish(run, tmp_path / "public", tmp_path / "told.json")
    assert "- not as in the protocol: the samples are projected by 'exact', not by 'reference'" in card.splitlines()
    assert "- warning: the samples and the reference overlap" in card.splitlines()


def test_scores_of_other_weights_and_taken_folders_are_refused(run, tmp_path, capsys):
    def error(*words):
        assert main(["publish", *map(str, words)]) == 2
        return the_one_line(capsys.readouterr().err, "publish")

    scores = (run.parent / "scores.json").read_text()
    weights = json.loads(scores)["inputs"]["samples"]["weights_sha256"]
    moved = scores.replace(str(run.parent), "/elsewhere")  # as if they came from another machine
    for others in ("0" * 64, ""):  # the second of another program, which has no weights of ours
        other = json.loads(moved.replace(weights, others))
        del other["sha256"]  # its own, that of what was altered
        (tmp_path / "other.json").write_text(json.dumps({**other, "sha256": sha256_of_json(other)}))
        assert "which were not sampled from" in error(run, tmp_path / "new", "--scores", tmp_path / "other.json")
    assert "then rounded" in error(run, tmp_path / "new", "--bits", "16", "--scores", run.parent / "scores.json")
    assert not (tmp_path / "new").exists()
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "thesis.tex").write_text("")
    assert "which is not empty" in error(run, tmp_path / "taken")
    assert "holds no finished model" in error(tmp_path / "taken", tmp_path / "new")
    assert "which cannot be used" in error(run, tmp_path / "new", "--scores", run / "run.json")
    shutil.copytree(run, tmp_path / "edited")
    for edited in ("[]", '{"preset": 5}', '{"preset": {"data": {"train": 5}}}', '{"preset": {"training": {"x": {}}}}'):
        (tmp_path / "edited" / "run.json").write_text(edited)
        assert "run.json, which cannot be used" in error(tmp_path / "edited", tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_model_of_prepared_scans_names_what_they_were_prepared_from(tmp_path, capsys, monkeypatch):
    """A prepared folder is called by its path, which is the user's; it says itself which scans it holds."""
    monkeypatch.chdir(tmp_path)
    private = tmp_path / "private_place"
    for split in ("train", "val"):
        words = ["-o", str(private / split), "--set", "data.columns=64", "--workers", "1"]
        assert main(["prepare", f"simulated:2:{split}", *words]) == 0
    data = [f"data.train={private / 'train'}", "data.val=private_place/val", "data.columns=64"]
    assert main(["train", "marginal", str(private / "run"), "--set", *data]) == 0
    assert main(["publish", str(private / "run"), "public"]) == 0
    files = contents(tmp_path / "public")
    assert all(b"private_place" not in of and bytes(tmp_path) not in of for of in files.values())
    data = json.loads(files["run.json"])["preset"]["data"]
    assert (data["train"], data["val"]) == (["simulated::train"], ["simulated::val"])
    head, body = head_of(files["README.md"].decode())
    assert "license" not in head
    assert "| train | simulated | train | " in body
    assert "| val | simulated | val | " in body


@pytest.mark.parametrize("written", [1, 2, 3, 4])
def test_a_command_that_was_killed_goes_on(run, tmp_path, written, monkeypatch, capsys):
    """Stop before the second, third, ... file, as a kill or a full disk does."""
    rename, whole, folder = os.replace, tmp_path / "whole", tmp_path / "killed"
    assert main(["publish", str(run), str(whole)]) == 0
    count = iter(range(9))

    def until_full(self, target):
        if next(count) >= written:
            raise OSError(errno.ENOSPC, "No space left on device")
        rename(self, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", until_full)
        assert main(["publish", str(run), str(folder)]) == 2
    assert "No space left on device" in capsys.readouterr().err
    assert len(contents(folder)) == written
    assert main(["publish", str(run), str(folder)]) == 0
    assert contents(folder) == contents(whole)
    capsys.readouterr()
    (folder / "README.md").write_text("my own words")
    assert main(["publish", str(run), str(folder)]) == 2, "a finished folder, whose card may have been edited"
    assert "which is not empty" in the_one_line(capsys.readouterr().err, "publish")
    assert (folder / "README.md").read_text() == "my own words"


def test_a_folder_begun_for_another_run_is_refused(run, tmp_path, capsys):
    assert main(["publish", str(run), str(tmp_path / "public")]) == 0
    (tmp_path / "public" / "README.md").unlink()
    about = json.loads((tmp_path / "public" / "run.json").read_text())
    (tmp_path / "public" / "run.json").write_text(json.dumps({**about, "commit": "another"}))
    assert main(["publish", str(run), str(tmp_path / "public")]) == 2
    assert "which is not empty" in capsys.readouterr().err


def test_no_source_of_a_run_is_searched(monkeypatch):
    """A run's own words about its data may name anything, such as the root of the disk."""
    monkeypatch.setattr(
        "lidargrit.data.datasets.shared.files.scans_below", lambda root: pytest.fail(f"searches {root}")
    )
    monkeypatch.setattr("lidargrit.data.datasets.folder.scans_below", lambda root: pytest.fail(f"searches {root}"))
    for source in ("/", "/::all", str(Path.home()), "."):
        assert data_set_of(source)[0] in ("", "folder")


def marginal(sensor="hdl64e_kitti_odometry"):
    rays = replace(lidargrit.load_sensor("hdl64e_kitti_odometry").with_columns(32), name=sensor)
    return Marginal(Marginal.Config(bins=8), rays)


def test_foreign_words_are_neither_html_nor_links_nor_tables():
    name = "a<img src=x onerror=alert(1)>\n# b `c` [d](http://e) | f"
    about = {
        "files": [{"name": name, "sha256": name}],
        "preset": {"title": name, "seed": name, "data": {"train": [f"simulated:5:{name}"]}},
        "torch": name,
    }
    for facts in (about, {**about, "files": []}):
        body = head_of(model_card(marginal(name), facts, Provenance()))[1]
        outside_code = re.sub(r"`[^`\n]*`", "", body.replace("\\`", ""))
        assert "<img" not in outside_code
        assert "\n# b" not in body
        assert "[d](" not in outside_code
        assert not re.search(r"(?<!\\)\| f", outside_code)


@pytest.mark.parametrize(
    ("sources", "licence"),
    [
        (["kitti_360:/data/k:train"], "cc-by-nc-sa-3.0"),
        (["simulated:100:train"], None),
        (["simulated:100:train", "kitti_raw:/data/raw"], "cc-by-nc-sa-3.0"),
        (["kitti_360:/data/k", "argoverse2:/data/a"], "other"),
        (["nuscenes:/data/n"], "other"),
        (["/data/somewhere/that/is/gone"], "other"),
        (["https://example.org/prepared"], "other"),
    ],
)
def test_the_licence_is_what_the_data_demand(sources, licence):
    card = model_card(marginal(), {"preset": {"data": {"train": sources}}}, Provenance())
    head, body = head_of(card)
    assert head.get("license") == licence
    assert ("non-commercial" in body) == any(name in " ".join(sources) for name in ("kitti", "nuscenes", "argo"))
    assert "/data" not in body
    assert "example.org" not in body


def test_terms_of_weights_that_were_taken_over_stay(tmp_path):
    """The scans of a donor bind the model as its own do, however many runs lie between."""
    data = {"data": {"train": ["kitti_odometry:/data/k"]}}
    fit = {"scans": 8, "batch_size": 2, "learning_rate": 0.1}
    imported = {"files": [{"name": "vq.pth", "sha256": "ab" * 32}]}
    write_json(tmp_path / "first" / "run.json", {"preset": {**data, "training": {"tokenizer": fit}}, **imported})
    preset = load_preset("lidargrit_demo", [f"training.tokenizer.start=frozen:{tmp_path / 'first'}"])
    about = {"preset": configuration.to_json(preset), "taken": taken_facts(preset)}
    write_json(tmp_path / "second" / "run.json", about)
    starts = [
        f"training.tokenizer.start=frozen:{tmp_path / 'second'}",
        f"training.transformer.start={tmp_path / 'second'}",
    ]
    again = load_preset("lidargrit_demo", starts)
    taken = taken_facts(again)
    assert taken["training"] == {"tokenizer": None}, "no run of ours trained it"
    head, body = head_of(model_card(marginal(), {"preset": configuration.to_json(again), "taken": taken}, Provenance()))
    assert head["license"] == "cc-by-nc-sa-3.0"
    assert "Some of the weights, or those that they were trained from, belong to their authors" in body
    assert "| train, of the weights that it took | kitti_odometry | all |" in body
    assert "| tokenizer, taken from another run | not known | - | - |" in body
    assert f"- `vq.pth`, SHA-256 `{'ab' * 32}`" in body


def test_a_run_that_took_stages_of_an_unknown_training_claims_no_free_terms(tmp_path):
    over = taken_facts(load_preset("lidargrit_demo", [f"training.tokenizer.start=frozen:{tmp_path}"]))
    assert head_of(model_card(marginal(), {"preset": {}, "taken": over}, Provenance()))[0]["license"] == "other"


def test_a_card_of_which_nothing_is_known_claims_nothing():
    head, body = head_of(model_card(marginal(), {}, Provenance()))
    assert "license" not in head
    for line in ("does not say which scans", "does not say which terms", "No scores were published with this model."):
        assert line in body


def test_a_card_of_imported_weights_names_their_files_and_their_authors_rights():
    about = {
        "origin": "published",
        "files": [{"name": "vq.pth", "sha256": "ab" * 32}],
        "preset": {"data": {"train": ["kitti_360::train"]}, "training": {"tokenizer": {"scans": 5}}},
    }
    body = head_of(model_card(marginal(), about, Provenance()))[1]
    assert f"- `vq.pth`, SHA-256 `{'ab' * 32}`" in body
    assert "were not trained by lidargrit" in body
    assert "The weights belong to their authors" in body
    assert "scans seen" not in body


@pytest.mark.parametrize(
    ("source", "name", "split"),
    [
        ("kitti_360:/data/k360:train_without_val[:90%]", "kitti_360", "train_without_val[:90%]"),
        ("kitti_360:/data/k360:lidargen-code/train", "kitti_360", "lidargen-code/train"),
        ("kitti_360:/data/k360", "kitti_360", "all"),
        ("simulated:2000:val", "simulated", "val"),
        ("kitti_360::train", "kitti_360", "train"),
        ("kitti_odometry:/data/a:/secret/b", "kitti_odometry", ""),
        ("/home/me/scans:00+03", "", "00+03"),
    ],
)
def test_a_source_without_its_place(source, name, split):
    assert data_set_and_split(source) == data_set_of(source) == (name, split)


def test_the_name_of_a_source_is_not_worth_a_walk_through_a_disk(tmp_path, monkeypatch):
    def walked(*arguments):
        raise AssertionError("the folder was searched")

    monkeypatch.setattr(_files, "scans_below", walked)
    monkeypatch.setattr(folder_of_scans, "scans_below", walked)
    assert data_set_of(str(tmp_path)) == ("folder", "all")
    write_example("kitti_odometry", tmp_path, 1)
    assert data_set_of(str(tmp_path)) == ("kitti_odometry", "all")


def test_prepared_scans_are_named_by_what_they_were_prepared_from(tmp_path):
    prepared = ["-o", str(tmp_path / "prepared"), "--set", "data.columns=64", "--workers", "1"]
    assert main(["prepare", "simulated:2:train", *prepared]) == 0
    assert data_set_of(str(tmp_path / "prepared")) == ("simulated", "train")

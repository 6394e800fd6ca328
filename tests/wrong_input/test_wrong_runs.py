"""Runs, weights and samples that are damaged or of another kind: one line, and nothing lost."""

import json
import random
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

import lidargrit
from lidargrit.cli import main
from lidargrit.data.formats.numpy_array import NumpyArray
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources import load_range_images
from lidargrit.data.sources.samples import read_samples
from lidargrit.scans.types import Scan
from tiny_runs import the_one_line, train_words


def test_a_folder_that_holds_another_run(refused, run_folder):
    message = refused(*train_words(run_folder, "model.transformer.layers=2"))
    assert "which holds another run (there model.transformer.layers=1, here 2)" in message
    assert "holds another run" in refused("demo", "--out", run_folder)


def test_a_folder_with_foreign_files(refused, run_folder, tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("years of work")
    for words, what in (
        (train_words(tmp_path / "thesis"), "which is not empty and holds no run; wanted an empty folder"),
        (train_words(tmp_path / "thesis" / "chapter.tex"), "which is not empty and holds no run"),
        (train_words(tmp_path / "thesis" / "chapter.tex" / "x"), "wanted a folder that may be written to"),
        (["demo", "--out", tmp_path / "thesis"], "which is not empty and holds no run"),
        (["sample", run_folder, tmp_path / "thesis"], "which is not empty and holds no samples.json; wanted an empty"),
        (["sample", run_folder, run_folder], "which is not empty and holds no samples"),
        (["sample", run_folder, tmp_path / "thesis" / "chapter.tex"], "which is not empty and holds no samples"),
    ):
        assert what in refused(*words)


def test_a_training_that_is_refused_leaves_its_folder_to_the_corrected_command(refused, tmp_path):
    for number in range(4):
        scan = lidargrit.simulate(seed=number)
        NumpyArray.write(tmp_path / "scans" / f"{number}.npz", Scan(scan.points_xyz_m, None, scan.ring))
    words = train_words(tmp_path / "new", f"data.train=[{tmp_path}/scans]", "model.tokenizer.reflectance=true")
    assert "without reflectance, for a model of model.tokenizer.reflectance=true" in refused(*words)


def test_samples_of_a_run_whose_recordings_are_damaged(refused, run_folder, tmp_path):
    (run_folder / "trained_on.json").write_text("{")
    assert "trained_on.json" in refused("sample", run_folder, tmp_path / "new", "-n", "1")


def test_samples_of_another_model_or_drawn_otherwise(refused, finished, samples):
    message = refused("sample", finished["deeper"], samples)
    assert "samples, which holds samples of another model or sampled in another way; wanted" in message
    assert "sampled in another way" in refused("sample", finished["run"], samples, "--set", "sampling.temperature=0.5")
    assert main(["sample", str(finished["run"]), str(samples), "-n", "2"]) == 0


@pytest.mark.parametrize(("stage", "other"), [("tokenizer", "wider"), ("transformer", "deeper")])
def test_weights_of_another_configuration(refused, finished, run_folder, tmp_path, stage, other):
    shutil.copy(finished[other] / stage / "checkpoint.safetensors", run_folder / stage)
    message = refused(*train_words(run_folder))
    assert re.search(rf"{stage}/checkpoint\.safetensors of another configuration \(.*; load them with", message)
    shutil.copy(finished[other] / "model.safetensors", run_folder)
    for words in (["sample", run_folder, tmp_path / "new"], ["view", run_folder, "-o", tmp_path / "picture.png"]):
        assert re.search(r"run/model\.safetensors of another configuration \(", refused(*words))


def test_a_configuration_of_other_weights(refused, run_folder, tmp_path):
    config = json.loads((run_folder / "config.json").read_text())
    for channels, text in ((64, r"model\.safetensors of another configuration \("), (33, r"channels=33; wanted")):
        config["config"]["tokenizer"]["channels"] = channels
        (run_folder / "config.json").write_text(json.dumps(config))
        assert re.search(text, refused("sample", run_folder, tmp_path / "new"))


@pytest.mark.parametrize(
    "damaged", [b"", b"{", b"[]", b"null", b"{}", b"\xff\xfe", b'{"generator": 3}', b'{"generator": "lidargri"}']
)
@pytest.mark.parametrize("name", ["config.json", "run.json"])
def test_json_that_is_not_ours(refused, run_folder, tmp_path, damaged, name):
    (run_folder / name).write_bytes(damaged)
    words = ["sample", run_folder, tmp_path / "new"] if name == "config.json" else train_words(run_folder)
    message = refused(*words)
    assert name in message


def test_a_run_whose_data_have_no_names(refused, run_folder):
    about = json.loads((run_folder / "run.json").read_text())
    (run_folder / "run.json").write_text(json.dumps({**about, "data": -1}))
    assert "run.json, whose 'data' hold no names; wanted" in refused(*train_words(run_folder))


@pytest.mark.parametrize(
    "change",
    [
        {"sensor": {}},
        {"sensor": {"elevation_rad": [[1], [2, 3]]}},
        {"config": 3},
        {"config": {"colour": 1}},
        {"config": {"transformer": None}},
        {"config": {"transformer": {"layers": 0}}},
        {"config": {"tokenizer": {"name": "none"}}},
        {"generator": 5},
    ],
)
def test_a_configuration_of_the_wrong_shape(refused, run_folder, tmp_path, change):
    config = json.loads((run_folder / "config.json").read_text())
    for key, value in change.items():
        config[key] = config[key] | value if isinstance(value, dict) and value else value
    (run_folder / "config.json").write_text(json.dumps(config))
    message = refused("sample", run_folder, tmp_path / "new")
    assert "config.json" in message
    assert "functools" not in message
    del config[next(iter(change))]
    (run_folder / "config.json").write_text(json.dumps(config))
    assert "config.json" in refused("sample", run_folder, tmp_path / "new")


@pytest.mark.parametrize("damage", ["cut short", "a few bytes", "empty", "garbage", "header", "a folder"])
def test_damaged_weights(refused, run_folder, tmp_path, damage):
    for path in (run_folder / "model.safetensors", run_folder / "transformer" / "checkpoint.safetensors"):
        content = path.read_bytes()
        path.unlink()
        if damage == "a folder":
            path.mkdir()
        else:
            path.write_bytes(
                {
                    "cut short": content[:-100],
                    "a few bytes": content[:5],
                    "empty": b"",
                    "garbage": random.Random(0).randbytes(len(content)),
                    "header": b"\xff" * 8 + content[8:],
                }[damage]
            )
    message = refused("sample", run_folder, tmp_path / "new")
    assert re.search(r"run/model\.safetensors, which cannot be read .*train again", message)
    message = refused(*train_words(run_folder))
    assert re.search(r"transformer/checkpoint\.safetensors, which cannot be read .*train again", message)
    if damage != "a folder":
        (run_folder / "transformer" / "checkpoint.safetensors").unlink()
        assert main(train_words(run_folder)) == 0, "the cure that the message names"
        assert main(["sample", str(run_folder), str(tmp_path / "new"), "-n", "1"]) == 0


def test_a_checkpoint_whose_bytes_changed_on_disk_is_read_or_refused(run_folder, tmp_path, capsys):
    path = run_folder / "model.safetensors"
    content = path.read_bytes()
    rng = random.Random(1)
    for _ in range(40):  # anywhere in the header: names, sizes, offsets, types
        damaged = bytearray(content)
        damaged[rng.randrange(8 + int.from_bytes(content[:8], "little"))] = rng.randrange(256)
        path.write_bytes(damaged)
        if main(["view", str(run_folder), "-o", str(tmp_path / "picture.png"), "-n", "9"]) == 2:
            the_one_line(capsys.readouterr().err, "view")


def zipped(path: Path, **arrays: np.ndarray) -> bytes:
    np.savez_compressed(path, **arrays)
    content = path.read_bytes()
    path.unlink()
    return content


@pytest.mark.parametrize(
    "damage",
    ["empty", "cut short", "garbage", "flipped bytes", "not zipped", "other", "size", "type", "nan", "negative"],
)
def test_a_broken_sample(refused, finished, samples, tmp_path, damage):
    path = samples / "00000001.npz"
    content, before = path.read_bytes(), read_samples(samples).batch([0, 1]).range_m
    image = np.ones((64, 64), np.float32)
    flipped = bytearray(content)
    flipped[len(content) // 2 : len(content) // 2 + 9] = b"123456789"
    np.save(tmp_path / "array.npy", image)
    not_zipped = (tmp_path / "array.npy").read_bytes()
    broken = {
        "empty": b"",
        "cut short": content[:-50],
        "garbage": random.Random(0).randbytes(500),
        "flipped bytes": bytes(flipped),
        "not zipped": not_zipped,
        "other": zipped(path, depth=image),
        "size": zipped(path, range_m=image[:, :32]),
        "type": zipped(path, range_m=image.astype(np.float64)),
        "nan": zipped(path, range_m=image * np.nan),
        "negative": zipped(path, range_m=-image),
    }[damage]
    path.write_bytes(broken)
    for words in (["evaluate", samples, "simulated:2:test"], ["view", samples, "-o", tmp_path / "picture.png"]):
        assert "00000001.npz" in refused(*words)
    path.unlink()
    assert main(["sample", str(finished["run"]), str(samples), "-n", "2"]) == 0, "the cure that the message names"
    assert torch.allclose(read_samples(samples).batch([0, 1]).range_m, before, atol=1e-3)


@pytest.mark.parametrize("damaged", [b"", b"{", b"[]", b"{}", b'{"sensor": {"name": 1}}'])
def test_a_broken_list_of_samples(refused, finished, samples, damaged):
    (samples / "samples.json").write_bytes(damaged)
    assert "samples.json" in refused("evaluate", samples, "simulated:2:test")
    assert "samples" in refused("sample", finished["run"], samples)


def test_a_folder_of_samples_with_no_sample_in_it(refused, samples):
    for path in samples.glob("*.npz"):
        path.unlink()
    assert "no sample in" in refused("evaluate", samples, "simulated:2:test")


@pytest.mark.parametrize("damage", ["gone", "cut short", "empty"])
def test_a_damaged_cache_is_made_anew(tmp_path, monkeypatch, damage):
    monkeypatch.setenv("LIDARGRIT_CACHE", str(tmp_path))
    config = DataConfig(train=("simulated:2",), val=(), columns=512, column_stride=8)
    before = load_range_images(config.train, config).batch([0, 1]).range_m
    (path,) = tmp_path.glob("*/images.zarr/range/c.*")
    content = path.read_bytes()
    path.unlink()
    if damage != "gone":
        path.write_bytes(content[: len(content) // 2] if damage == "cut short" else b"")
    assert (load_range_images(config.train, config).batch([0, 1]).range_m == before).all()

"""What a user can do wrong, and what a machine can: one line that says what to do, and nothing lost."""

import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch

from lidargrit import reporting
from lidargrit.cli import main
from lidargrit.datasets import load
from lidargrit.evaluation.samples import read_samples
from lidargrit.files import read_tensors
from lidargrit.loading import DataConfig, load_range_images

MODEL = [  # 64x64 range images, 8x8 tokens
    "data.columns=512",
    "data.column_stride=8",
    "model.tokenizer.channel_multipliers=[1,1,1,1]",
    "model.tokenizer.code_dim=8",
    "model.tokenizer.num_codes=32",
    "model.transformer.layers=1",
    "model.transformer.heads=2",
    "model.transformer.width=16",
    "training.tokenizer.batch_size=4",
    "training.transformer.batch_size=8",
]
SIMULATED = ["data.train=[simulated:4:train]", "data.val=[simulated:1:val]"]
SHORT = ["training.tokenizer.scans=4", "training.transformer.scans=8"]
LONG = [  # 12 and 6 steps, a checkpoint after each
    "training.tokenizer.scans=48",
    "training.tokenizer.checkpoint_every=4",
    "training.transformer.scans=48",
    "training.transformer.checkpoint_every=8",
]
PROGRESS = re.compile(
    r"(projecting scans|training \w+|sampling): \d+/\d+|  after \d+ scans|\s*WARNING: |left out: |lidargrit demo: "
    r"about "
)


@pytest.fixture(scope="module", autouse=True)
def _cache(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LIDARGRIT_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


def train_words(folder: Path, *settings: str) -> list[str]:
    return ["train", "demo", str(folder), "--set", *MODEL, *SIMULATED, *SHORT, *settings]


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> dict[str, Path]:
    """Return finished runs that differ in their sizes."""
    root = tmp_path_factory.mktemp("runs")
    changes = {"run": [], "wider": ["model.tokenizer.channels=64"], "deeper": ["model.transformer.layers=2"]}
    for name, settings in changes.items():
        assert main(train_words(root / name, *settings)) == 0
    assert main(["sample", str(root / "run"), str(root / "samples"), "-n", "2"]) == 0
    return {name: root / name for name in (*changes, "samples")}


@pytest.fixture
def run_folder(finished, tmp_path) -> Path:
    """Return a copy of a finished run, to be damaged."""
    return shutil.copytree(finished["run"], tmp_path / "run")


@pytest.fixture
def samples(finished, tmp_path) -> Path:
    return shutil.copytree(finished["samples"], tmp_path / "samples")


@pytest.fixture(scope="module")
def rows(tmp_path_factory) -> np.ndarray:
    """Return the rows of a good scan."""
    folder = tmp_path_factory.mktemp("good")
    load("folder").write_example(folder, 1)
    return np.fromfile(folder / "000000.bin", dtype="<f4").reshape(-1, 4)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def the_one_line(stderr: str, verb: str) -> str:
    """Return the error among the lines on stderr, having checked that it is one line with its three parts."""
    lines = [line for line in stderr.splitlines() if not PROGRESS.match(line)]
    assert len(lines) == 1, stderr
    assert re.fullmatch(rf"lidargrit {verb}: got \S.*; wanted \S.*; \S.*", lines[0]), stderr
    return lines[0]


@pytest.fixture
def refused(capsys, tmp_path):
    """Return a function that runs a command, which must be refused and change nothing, and returns the one line."""

    def run(*words: object) -> str:
        capsys.readouterr()
        before = contents(tmp_path)
        assert main([str(word) for word in words]) == 2
        captured = capsys.readouterr()
        after = contents(tmp_path)
        assert {name: after.get(name) for name in before} == before, "what was there is not there any more"
        assert after.keys() == before.keys(), "something was left behind"
        assert captured.out == ""
        return the_one_line(captured.err, str(words[0]))

    return run


def changed(rows: np.ndarray, name: str) -> bytes:
    """Return a damaged scan as the bytes of a file."""
    bad = rows.copy()
    if name == "NaN":
        bad[7, 0] = np.nan
    elif name == "infinite":
        bad[7:9, 2] = -np.inf
    elif name == "origin":
        bad[7, :3] = 0
    elif name == "reflectance":
        bad[:, 3] *= 255
    return {"cut short": bad.tobytes()[:-3], "empty": b""}.get(name, bad.tobytes())


DAMAGE = {
    "cut short": r"got \d+ bytes in .*BAD.*, 13 more than whole points; wanted .*16 bytes a point; download it again",
    "empty": r"got an empty file, .*BAD.*; wanted float32 rows .*; download it again, or remove it",
    "NaN": r"got 1 of \d+ points NaN or infinite coordinates in .*BAD.*; --?.*|.*bad_points=drop",
    "infinite": r"got 2 of \d+ points NaN or infinite coordinates in .*BAD.*; .*--set data\.bad_points=drop",
    "origin": r"got 1 of \d+ points at the origin .* in .*BAD.*; .*--set data\.bad_points=drop",
    "reflectance": r"got reflectance from 0 to \d+.* in .*BAD.*; wanted values in \[0, 1\]; .*divide",
}


@pytest.mark.parametrize("damage", DAMAGE)
@pytest.mark.parametrize("verb", ["train", "view", "evaluate", "demo"])
def test_a_damaged_scan(refused, rows, tmp_path, verb, damage):
    folder = tmp_path / "scans"
    folder.mkdir()
    for index in range(8):
        (folder / f"{index:06d}.bin").write_bytes(changed(rows, "not at all"))
    (folder / "000001.bin").write_bytes(changed(rows, damage))
    words = {
        "train": [*train_words(tmp_path / "run"), f"data.train=[{folder}]"],
        "view": ["view", folder, "-o", tmp_path / "picture.png", "-n", 8],
        "evaluate": ["evaluate", folder, "simulated:1:test", "--json", tmp_path / "scores.json"],
        "demo": ["demo", "--data", folder, "--out", tmp_path / "run", "--set", *MODEL, *SHORT],
    }[verb]
    assert re.search(DAMAGE[damage].replace("BAD", re.escape("scans/000001.bin")), refused(*words))


@pytest.mark.parametrize("damage", ["NaN", "infinite", "origin"])
def test_bad_points_are_dropped_by_the_setting_that_the_message_names(refused, rows, tmp_path, damage):
    (tmp_path / "scans").mkdir()
    (tmp_path / "scans" / "000001.bin").write_bytes(changed(rows, damage))
    words = [*train_words(tmp_path / "run"), f"data.train=[{tmp_path / 'scans'}]", f"data.val=[{tmp_path / 'scans'}]"]
    setting = re.search(r"--set (data\.bad_points=\w+)", refused(*words))
    assert setting
    assert main([*words, setting[1]]) == 0, "the same folder can be used: nothing had begun"
    assert (tmp_path / "run" / "model.safetensors").exists()


@pytest.mark.parametrize("damage", DAMAGE)
def test_bad_scans_are_left_out_by_the_setting_that_the_message_names(refused, rows, tmp_path, capsys, damage):
    (tmp_path / "scans").mkdir()
    for index, name in enumerate(("not at all", damage, "not at all")):
        (tmp_path / "scans" / f"{index:06d}.bin").write_bytes(changed(rows, name))
    words = [*train_words(tmp_path / "run"), f"data.train=[{tmp_path / 'scans'}]"]
    setting = re.search(r"--set (data\.bad_scans=\w+)", refused(*words))
    assert setting
    assert main([*words, setting[1]]) == 0
    told = capsys.readouterr().err
    assert told.count("left out: got ") == 1
    assert "000001.bin" in told
    (tmp_path / "scans" / "000000.bin").unlink()
    (tmp_path / "scans" / "000002.bin").unlink()
    assert "no usable scan in" in refused(*train_words(tmp_path / "none"), *words[-1:], setting[1])


REAL_DAMAGE = {
    "incomplete_sweep_39_rings": r"got 39 rings in .*; wanted the 64 rings .*; remove the file if the sweep was cut",
    "cropped_to_camera": r"got returns in only .* of 360 degrees of azimuth in .*; wanted a full revolution",
    "all_columns_times_1p1_plus_0p1": r"got reflectance from .* to 1.* in .*; wanted values in \[0, 1\]",
}


@pytest.mark.shared
@pytest.mark.parametrize("name", REAL_DAMAGE)
def test_a_real_damaged_scan(refused, real, rows, tmp_path, capsys, name):
    (tmp_path / "scans").mkdir()
    shutil.copy(real / "damaged" / f"{name}.bin", tmp_path / "scans")
    assert re.search(REAL_DAMAGE[name], refused("view", tmp_path / "scans", "-o", tmp_path / "picture.png"))
    words = [*train_words(tmp_path / "run"), f"data.train=[{tmp_path / 'scans'}]"]
    assert re.search(REAL_DAMAGE[name], refused(*words))
    (tmp_path / "scans" / "good.bin").write_bytes(rows.tobytes())
    assert main([*words, "data.bad_scans=skip"]) == 0
    assert re.search(f"left out: {REAL_DAMAGE[name]}", capsys.readouterr().err)


def test_a_folder_with_no_scan_in_it(refused, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("no scan")
    for folder, what in (("empty", "holds no layout we know"), ("other", "holds"), ("none", "is not a folder")):
        place = tmp_path / folder
        for words in (
            [*train_words(tmp_path / "run"), f"data.train=[{place}]"],
            ["demo", "--data", place, "--out", tmp_path / "run"],
            ["evaluate", place, "simulated:1:test"],
            ["view", place, "-o", tmp_path / "picture.png"],
        ):
            assert re.search(f"{folder}, which {what}.*lidargrit list datasets", refused(*words))
    assert "no scan where this data set has them" in refused("view", f"kitti_raw:{tmp_path / 'other'}")


def test_a_sensor_that_does_not_fit_the_scan(refused, tmp_path):
    azimuth, elevation = np.meshgrid(
        np.linspace(0, 2 * np.pi, 900, endpoint=False), np.radians(np.linspace(15, -15, 16))
    )
    flat = np.cos(elevation)
    xyz_m = 10 * np.stack((flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)), axis=-1).reshape(-1, 3)
    (tmp_path / "puck").mkdir()
    np.column_stack((xyz_m, np.full(len(xyz_m), 0.5))).astype("<f4").tofile(tmp_path / "puck" / "0.bin")
    settings = [f"data.train=[{tmp_path / 'puck'}]", "data.sensor=hdl64e_kitti_360", "data.projection=spherical"]
    told = refused(*train_words(tmp_path / "run", *settings))
    assert re.search(r"got \d\d% of the points of .*puck/0\.bin outside the sensor's elevations .*-15.0 to 15.0", told)
    assert re.search(r"wanted -2\d\.\d to \d\.\d degrees for 'hdl64e_kitti_360'; choose the sensor that made", told)
    told = refused(*train_words(tmp_path / "run", *settings[:1]))
    assert re.search(r"got 16 rings in .*puck/0\.bin; wanted the 64 rings of the sensor 'hdl64e_kitti_odometry'", told)


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["train", "smal", "OUT"], r"'smal', which is not among the recipes; wanted one of small.*list recipes"),
        (["train", "demo", "OUT", "--set", "seed"], r"the setting 'seed'; wanted NAME=VALUE; e\.g\. --set title="),
        (
            ["train", "demo", "OUT", "--set", "model.tokenizer.chanels=32"],
            r"'model\.tokenizer\.chanels', which .*channels",
        ),
        (
            ["train", "demo", "OUT", "--set", "training.tokeniser.scans=4"],
            r"wanted one such as training\.tokenizer\.scans",
        ),
        (["train", "demo", "OUT", "--set", "seed=many"], r"seed=many; wanted a value of the type int"),
        (["train", "demo", "OUT", "--set", "data.train=[]"], r"no source of scans; .*data\.train="),
        (
            ["train", "demo", "OUT", "--set", "data.train=[kiti_odometry:/d]"],
            r"'kiti_odometry', which .*kitti_odometry",
        ),
        (
            ["train", "demo", "OUT", "--set", "data.train=[simulated]"],
            r"the source 'simulated' alone; .*simulated:1000",
        ),
        (["train", "demo", "OUT", "--set", "data.sensor=hdl64"], r"'hdl64', which is not among the sensors; .*hdl64e_"),
        (["train", "demo", "OUT", "--set", "data.sensor=no.json"], r"the sensor file no\.json, which cannot be read"),
        (["train", "demo", "OUT", "--set", "data.columns=100", "data.column_stride=8"], r"100 columns, every 8th kept"),
        (["train", "demo", "OUT", "--set", "data.columns=80"], r"range images of 64x10; .*divisible by 8"),
        (["train", "demo", "OUT", "--set", "generator=lidargri"], r"'lidargri', which is not among the generators"),
        (["train", "demo", "OUT", "--set", "model.tokenizer.channels=40"], r"channels=40; .* multiple of 32"),
        (["train", "demo", "OUT", "--set", "data.max_scans=-1"], r"max_scans=-1; wanted"),
        (["train", "demo", "OUT", "--set", "seed=-1"], r"seed=-1; wanted"),
        (["train", "demo", "OUT", "--set", "training.tokenizer.betas=[2.0,3.0]"], r"betas=\(2\.0, 3\.0\); wanted"),
        (["train", "demo", "OUT", "--set", "training.tokenizer.weight_decay=-1"], r"weight_decay=-1\.0; wanted"),
        (["train", "demo", "OUT", "--set", "model.transformer.residual_dropout=2"], r"residual_dropout=2\.0; wanted"),
        (
            ["train", "demo", "OUT", "--set", "training.tokenizer.average_over_scans=-1"],
            r"average_over_scans=-1; wanted",
        ),
        (["sample", "RUN", "OUT", "-n", "0"], r"-n 0, .*; wanted at least one scan"),
        (["sample", "RUN", "OUT", "--seed", "-1"], r"--seed -1; wanted"),
        (["sample", "RUN", "OUT", "--top-p", "0"], r"top_p=0\.0; wanted"),
        (["sample", "RUN", "OUT", "--temperature", "nan"], r"temperature=nan, .*; wanted temperature >= 0"),
        (["sample", "RUN", "OUT", "--device", "gpu"], r"--device gpu; wanted"),
        (["sample", "nowhere", "OUT"], r"nowhere, which holds no finished model; .*finish the training"),
        (
            ["evaluate", "simulated:1", "simulated:1", "--metrics", "slice"],
            r"'slice', which .*metrics; .*sliced_wasserstein",
        ),
        (["evaluate", "simulated:1", "simulated:1", "-n", "-1"], r"-n -1, --seed 0; wanted 0 or more"),
        (["evaluate", "simulated:1", "simulated:1", "--seed", "-1"], r"seed.*-1; wanted"),
        (["evaluate", "SAMPLES", "SAMPLES", "-n", "-1"], r"-n -1, --seed 0; wanted 0 or more"),
        (["evaluate", "simulated:1:val", "SAMPLES"], r"64x\d+.*; wanted the rays of .*give the samples first"),
        (["view", "simulated:1", "-o", "OUT", "-n", "0"], r"-n 0.*; wanted|0 scans.*; wanted"),
        (["view", "simulated:9", "-o", "OUT", "-n", "9"], r"; wanted .*1 to 8"),
        (["view", "RUN", "-o", "OUT", "-n", "9"], r"; wanted .*1 to 8"),
        (["view", "simulated:1", "-o", "RUN/run.json/x.png"], r"x\.png, which cannot be written"),
        (["demo", "--data", "simulated:many", "--out", "OUT"], r"'many' where a count belongs"),
    ],
)
def test_wrong_words(refused, finished, tmp_path, words, text):
    for word, place in (("OUT", tmp_path / "out"), ("RUN", finished["run"]), ("SAMPLES", finished["samples"])):
        words = [re.sub(f"^{word}\\b", str(place), each) for each in words]
    if words[0] == "train":
        words = [*words, "--set", *MODEL, *SIMULATED, *SHORT, *words[4:]] if "--set" in words else words
    assert re.search(text, refused(*words))


def test_a_folder_that_holds_another_run(refused, run_folder):
    told = refused(*train_words(run_folder, "model.transformer.layers=2"))
    assert "which holds another run (there model.transformer.layers=1, here 2)" in told
    assert "holds another run" in refused("demo", "--out", run_folder)


def test_a_folder_with_foreign_files(refused, run_folder, tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("years of work")
    for words, what in (
        (train_words(tmp_path / "thesis"), "which is not empty and holds no run; wanted an empty folder"),
        (train_words(tmp_path / "thesis" / "chapter.tex"), "which is not empty and holds no run"),
        (train_words(tmp_path / "thesis" / "chapter.tex" / "x"), "while writing"),
        (["demo", "--out", tmp_path / "thesis"], "which is not empty and holds no run"),
        (["sample", run_folder, tmp_path / "thesis"], "which is not empty and holds no samples; wanted an empty"),
        (["sample", run_folder, run_folder], "which is not empty and holds no samples"),
        (["sample", run_folder, tmp_path / "thesis" / "chapter.tex"], "which is not empty and holds no samples"),
    ):
        assert what in refused(*words)


def test_samples_of_another_model_or_drawn_otherwise(refused, finished, samples):
    told = refused("sample", finished["deeper"], samples)
    assert "samples, which holds samples of another model or drawn in another way; wanted" in told
    assert "drawn in another way" in refused("sample", finished["run"], samples, "--temperature", 0.5)
    assert main(["sample", str(finished["run"]), str(samples), "-n", "2"]) == 0


@pytest.mark.parametrize(("stage", "other"), [("tokenizer", "wider"), ("transformer", "deeper")])
def test_weights_of_another_configuration(refused, finished, run_folder, tmp_path, stage, other):
    shutil.copy(finished[other] / stage / "checkpoint.safetensors", run_folder / stage)
    told = refused(*train_words(run_folder))
    assert re.search(rf"{stage}/checkpoint\.safetensors of another configuration \(.*; load them with", told)
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
    told = refused(*words)
    assert name in told or "not among the generators" in told


@pytest.mark.parametrize(
    "change",
    [
        {"sensor": {}},
        {"sensor": {"elevation_rad": [[1], [2, 3]]}},
        {"config": 3},
        {"config": {"colour": 1}},
    ],
)
def test_a_configuration_of_the_wrong_shape(refused, run_folder, tmp_path, change):
    config = json.loads((run_folder / "config.json").read_text())
    for key, value in change.items():
        config[key] = config[key] | value if isinstance(value, dict) and value else value
    (run_folder / "config.json").write_text(json.dumps(config))
    assert "config.json" in refused("sample", run_folder, tmp_path / "new")
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
    told = refused("sample", run_folder, tmp_path / "new")
    assert re.search(r"run/model\.safetensors, which cannot be read .*train again", told)
    told = refused(*train_words(run_folder))
    assert re.search(r"transformer/checkpoint\.safetensors, which cannot be read .*train again", told)
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
    (path,) = tmp_path.glob("*.npy")
    content = path.read_bytes()
    path.unlink()
    if damage != "gone":
        path.write_bytes(content[: len(content) // 2] if damage == "cut short" else b"")
    assert (load_range_images(config.train, config).batch([0, 1]).range_m == before).all()


class Interrupted(reporting.TerminalReporter):
    """Presses Ctrl-C after some steps of training."""

    steps = 0

    @contextmanager
    def progress(self, what: str, total: int, done: int = 0) -> Iterator[reporting.Progress]:
        left = iter(range(self.steps - 1)) if what.startswith("training") else iter(range(1 << 30))

        class Pressed(reporting.Progress):
            def advance(self, amount: int, note: str = "") -> None:
                if next(left, None) is None:
                    raise KeyboardInterrupt

        yield Pressed()


@pytest.fixture
def interrupt(monkeypatch):
    """Return a function that runs a command and interrupts it at a step of its training."""

    def run(steps: int, words: list[str]) -> int:
        with monkeypatch.context() as patch:
            patch.setattr(Interrupted, "steps", steps)
            patch.setattr(reporting, "TerminalReporter", Interrupted)
            return main(words)

    return run


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory) -> bytes:
    """Return the weights of a run that nothing happened to."""
    folder = tmp_path_factory.mktemp("uninterrupted") / "run"
    assert main(train_words(folder, *LONG)) == 0
    return (folder / "model.safetensors").read_bytes()


def hidden(folder: Path) -> list[Path]:
    return [path for path in folder.rglob(".*") if path.is_file()]


def test_interrupted_runs_say_so_and_go_on_to_the_same_weights(interrupt, uninterrupted, tmp_path, capsys):
    words = train_words(tmp_path / "run", *LONG)
    for steps in (1, 5, 1, 4, 6):  # the last in the second stage
        assert interrupt(steps, words) == 130
        told = capsys.readouterr().err.strip().splitlines()
        assert told[-1] == "lidargrit train: interrupted; the same command goes on"
        assert "Traceback" not in "".join(told)
    assert not (tmp_path / "run" / "config.json").exists()
    assert main(["sample", str(tmp_path / "run"), str(tmp_path / "new")]) == 2
    assert "which holds no finished model" in capsys.readouterr().err
    assert main(words) == 0
    assert (tmp_path / "run" / "model.safetensors").read_bytes() == uninterrupted
    assert hidden(tmp_path) == []


def lidargrit(words: list[str], **options) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "lidargrit", *words]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)


def limited_to(size: int):
    """Return what a new process does first: files may not grow beyond a size, as on a disk that is full."""

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    return limit


def test_a_real_interrupt_from_the_keyboard(interrupt, tmp_path):
    words = train_words(tmp_path / "run", *LONG, "training.tokenizer.scans=1000000")
    process = lidargrit(words)
    checkpoint = tmp_path / "run" / "tokenizer" / "checkpoint.safetensors"
    deadline = time.monotonic() + 60
    while not checkpoint.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=60)
    assert process.returncode == 130, told
    assert told.endswith("\nlidargrit train: interrupted; the same command goes on\n")
    assert "Traceback" not in told
    seen = read_tensors(checkpoint)[1]["scans_seen"]
    assert hidden(tmp_path) == []
    assert interrupt(3, words) == 130
    assert read_tensors(checkpoint)[1]["scans_seen"] == seen + 8, "two more steps, and the third not to its end"


def test_a_full_disk_during_a_save(interrupt, uninterrupted, tmp_path):
    words = train_words(tmp_path / "run", *LONG)
    assert interrupt(4, words) == 130
    before = contents(tmp_path)
    process = lidargrit(words, preexec_fn=limited_to(100_000))
    _, told = process.communicate(timeout=60)
    assert process.returncode == 2, told
    line = the_one_line(told, "train")
    assert re.search(r"got '.*' while writing .*checkpoint\.safetensors; .*free some space", line)
    name = "run/tokenizer/checkpoint.safetensors"
    assert contents(tmp_path)[name] == before[name]
    assert hidden(tmp_path) == []
    assert main(words) == 0
    assert (tmp_path / "run" / "model.safetensors").read_bytes() == uninterrupted


def test_a_full_disk_while_sampling(run_folder, samples, tmp_path):
    before = contents(tmp_path)
    process = lidargrit(["sample", str(run_folder), str(samples), "-n", "3"], preexec_fn=limited_to(1000))
    _, told = process.communicate(timeout=60)
    assert process.returncode == 2, told
    assert re.search(r"got '.*' while writing .*00000002\.npz; .*free some space", the_one_line(told, "sample"))
    assert contents(tmp_path) == before


def test_a_full_disk_before_the_first_step_and_while_projecting(tmp_path):
    for size, wanted in ((0, "run.json"), (8_000, r"\.npy")):
        process = lidargrit(
            train_words(tmp_path / "run"),
            preexec_fn=limited_to(size),
            env=os.environ | {"LIDARGRIT_CACHE": str(tmp_path / "cache")} if size else None,
        )
        _, told = process.communicate(timeout=60)
        assert process.returncode == 2, told
        assert re.search(rf"got '.*' while writing .*{wanted}; ", the_one_line(told, "train"))
        assert hidden(tmp_path) == []
    assert main(train_words(tmp_path / "run")) == 0


def test_a_full_disk_while_logging(tmp_path, interrupt):
    words = train_words(tmp_path / "run", *LONG)
    assert interrupt(4, words) == 130
    log = tmp_path / "run" / "tokenizer" / "log.jsonl"
    log.mkdir()  # stands for anything that keeps the file from being opened
    process = lidargrit(words)
    _, told = process.communicate(timeout=60)
    assert process.returncode == 2, told
    assert "log.jsonl" in the_one_line(told, "train")


KILLER = """
import os, random, signal, sys, time
import lightning_fabric, safetensors.torch
import lidargrit.cli, lidargrit.evaluation.samples, lidargrit.generators.lidargrit
import lidargrit.recipes, lidargrit.training

rng = random.Random(int(sys.argv[1]))
for _ in range(int(sys.argv[2])):
    child = os.fork()
    if not child:
        os._exit(lidargrit.cli.main(sys.argv[4:]))
    time.sleep(rng.uniform(0, float(sys.argv[3])))
    os.kill(child, signal.SIGKILL)
    if os.waitpid(child, 0)[1] not in (0, signal.SIGKILL):
        sys.exit("a killed command left something that the next could not go on from")
"""


def killed_often(times: int, longest_s: float, words: list[str]) -> None:
    command = [sys.executable, "-c", KILLER, "5", str(times), str(longest_s), *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr


def test_a_run_that_is_killed_again_and_again_ends_with_the_same_weights(uninterrupted, tmp_path):
    words = train_words(tmp_path / "run", *LONG)
    killed_often(6, 1.0, words)
    assert main(words) == 0
    assert (tmp_path / "run" / "model.safetensors").read_bytes() == uninterrupted
    for stage in ("tokenizer", "transformer"):
        seen = [
            json.loads(line)["scans_seen"] for line in (tmp_path / "run" / stage / "log.jsonl").read_text().splitlines()
        ]
        assert seen == sorted(set(seen)), "every line once"


def test_sampling_that_is_killed_again_and_again_ends_with_the_same_scans(finished, tmp_path):
    words = ["sample", str(finished["run"]), str(tmp_path / "new"), "-n", "24", "--batch-size", "1"]
    killed_often(5, 0.4, words)
    assert main(words) == 0
    assert main(["sample", str(finished["run"]), str(tmp_path / "one"), "-n", "24", "--batch-size", "1"]) == 0
    new, one = read_samples(tmp_path / "new"), read_samples(tmp_path / "one")
    assert new.names == one.names
    assert (new.batch(range(24)).range_m == one.batch(range(24)).range_m).all()


def test_what_a_killed_process_leaves_half_written_breaks_nothing(refused, run_folder, samples, tmp_path):
    for path in (*samples.iterdir(), *run_folder.rglob("*.*")):
        if path.is_file():
            path.with_name(f".{path.name}.abc12345{path.suffix}").write_bytes(b"half")
    assert len(read_samples(samples)) == 2
    for words in (
        train_words(run_folder),
        ["sample", str(run_folder), str(samples), "-n", "3"],
        ["evaluate", str(samples), "simulated:2:test"],
        ["view", str(samples), str(run_folder), "-o", str(tmp_path / "picture.png"), "-n", "1"],
    ):
        assert main(words) == 0


@pytest.mark.parametrize("name", ["run.json", "samples.json"])
def test_a_process_killed_while_it_wrote_its_very_first_file(run_folder, tmp_path, name):
    folder = tmp_path / "new"
    folder.mkdir()
    (folder / f".{name}.abc12345.json").write_bytes(b"half")
    assert main(train_words(folder) if name == "run.json" else ["sample", str(run_folder), str(folder), "-n", "1"]) == 0

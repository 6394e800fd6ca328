"""The relay of benchmarks/: training that stops, travels in a few files, and goes on elsewhere."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from threading import Thread

import numpy as np
import pytest
import torch

from lidargrit.core.errors import CheckpointError, OutputError, Terminated
from lidargrit.core.files import read_json, read_tensors, write_json
from lidargrit.data.images import RangeImages
from lidargrit.data.run_folder import CHECKPOINT_FILE
from lidargrit.generation.generator import load_class
from lidargrit.generation.presets import load_preset
from lidargrit.generation.settings import TrainingConfig
from lidargrit.scans.sensors import load_sensor
from lidargrit.systems.lidargrit.system import LidarGrit
from lidargrit.training.stage import StageTraining
from seeded_images import SeededImages

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "benchmarks" / "relay"))

from leg import Leg, run_leg  # noqa: E402
from packing import MANIFEST, RELAY_FILE, pack, unpack  # noqa: E402
from streets import Streets  # noqa: E402

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(32, 1)
IMAGES = RangeImages(SENSOR, [SeededImages(SENSOR, 8)])
STEPS = TrainingConfig(scans=150, batch_size=1, learning_rate=1e-3, average_over_scans=20, validate_every=10**6)
MIB = 2**20


def fit(folder, config=STEPS):
    torch.manual_seed(0)
    cls = load_class("r2dm")
    objective = cls(replace(cls.smallest_config(SENSOR), reflectance=False), SENSOR).objective("diffusion")
    return StageTraining(objective, config, folder / "tokenizer", 0).begun()


@pytest.fixture(scope="module")
def half(tmp_path_factory):
    """A relay whose tokenizer has learned from a third of its scans."""
    run = tmp_path_factory.mktemp("half")
    fit(run, replace(STEPS, scans=50, checkpoint_every=50)).run(IMAGES, IMAGES, "")
    write_json(run / RELAY_FILE, {"preset": "toy", "next_seed": 8, "finished": [], "legs": []})
    return run


def packed_in_fewer_and_fewer_bits(run, out):
    """Return the folders of all roundings, from the most bits to the fewest, by lowering the room until none fits."""
    folders, room = [], 40 * MIB
    while True:
        folder = out / str(len(folders))
        try:
            pack(run, folder, room)
        except OutputError:
            return folders
        folders.append(folder)
        room = sum(path.stat().st_size for path in folder.glob("relay_part_*")) - 1


def test_a_run_that_travelled_in_few_bits_is_within_1_percent_100_steps_later(half, tmp_path):
    folders = packed_in_fewer_and_fewer_bits(half, tmp_path)
    assert len(folders) == 6
    unpack(folders[3], tmp_path / "elsewhere")  # all rounded, moments included
    unpack(folders[4], tmp_path / "unaveraged")  # moments and weights, whose average begins anew
    unpack(folders[5], tmp_path / "anew")  # without moments
    of_weights = {
        name: read_tensors(tmp_path / name / "tokenizer" / CHECKPOINT_FILE)[0] for name in ("elsewhere", "unaveraged")
    }
    assert of_weights["elsewhere"].keys() == of_weights["unaveraged"].keys()
    for name, tensor in of_weights["unaveraged"].items():
        expected = of_weights["elsewhere"][name.replace("average.", "objective.", 1)]
        assert torch.equal(tensor, expected), name
    shutil.copytree(half, tmp_path / "kept")
    kept, travelled, anew = (fit(tmp_path / name) for name in ("kept", "elsewhere", "anew"))
    assert kept.scans_seen == travelled.scans_seen == anew.scans_seen == 50
    pairs = zip(kept.objective.parameters(), travelled.objective.parameters(), strict=True)
    assert any(not torch.equal(*pair) for pair in pairs), "nothing was rounded"
    for each in (kept, travelled):
        each.run(IMAGES, IMAGES, "")
    losses = [each.validate(IMAGES)["loss"] for each in (kept, travelled)]
    assert losses[1] == pytest.approx(losses[0], rel=0.01)


def test_where_there_is_room_nothing_is_rounded(half, tmp_path):
    pack(half, tmp_path / "out")
    unpack(tmp_path / "out", tmp_path / "elsewhere")
    before, after = (
        read_tensors(run / "tokenizer" / "checkpoint.safetensors") for run in (half, tmp_path / "elsewhere")
    )
    assert before[1] == after[1]
    assert before[0].keys() == after[0].keys()
    assert all(torch.equal(before[0][name], after[0][name]) for name in before[0])


def test_of_a_finished_stage_the_average_alone_travels(half, tmp_path):
    pack(half, tmp_path / "whole")
    state = read_json(half / RELAY_FILE)
    write_json(half / RELAY_FILE, {**state, "finished": ["tokenizer"]})
    try:
        pack(half, tmp_path / "out")
    finally:
        write_json(half / RELAY_FILE, state)
    sizes = [(tmp_path / name / "relay_part_0").stat().st_size for name in ("out", "whole")]
    assert sizes[0] < sizes[1] / 2
    unpack(tmp_path / "out", tmp_path / "elsewhere")
    tensors, _ = read_tensors(tmp_path / "elsewhere" / "tokenizer" / "checkpoint.safetensors")
    weights = [name for name in tensors if name.startswith("average.")]
    assert weights
    assert all(torch.equal(tensors[name], tensors[name.replace("average", "objective", 1)]) for name in weights)
    assert fit(tmp_path / "elsewhere").scans_seen == 50


@pytest.mark.parametrize(
    "harm", [lambda part: part.unlink(), lambda part: part.write_bytes(part.read_bytes()[:-1] + b"x")]
)
def test_a_missing_or_damaged_part_is_named_and_changes_nothing(half, tmp_path, harm):
    pack(half, tmp_path / "out")
    unpack(tmp_path / "out", tmp_path / "elsewhere")
    held = {path: path.read_bytes() for path in (tmp_path / "elsewhere").rglob("*.*")}
    harm(tmp_path / "out" / "relay_part_0")
    with pytest.raises(CheckpointError, match="relay_part_0"):
        unpack(tmp_path / "out", tmp_path / "elsewhere")
    assert held == {path: path.read_bytes() for path in (tmp_path / "elsewhere").rglob("*.*")}


def test_names_that_lead_out_of_the_folder_are_refused(half, tmp_path):
    pack(half, tmp_path / "out")
    write_json(tmp_path / "out" / MANIFEST, {"parts": {"../x": "0"}})
    with pytest.raises(CheckpointError, match="names no parts"):
        unpack(tmp_path / "out", tmp_path / "elsewhere")


def test_training_stops_and_saves_when_its_time_is_over(tmp_path):
    long = fit(tmp_path, replace(STEPS, scans=10**6))
    long.deadline_s = time.monotonic() + 1.5
    with pytest.raises(Terminated):
        long.run(IMAGES, IMAGES, "")
    assert 0 < fit(tmp_path, replace(STEPS, scans=10**6)).scans_seen == long.scans_seen


def toy_preset():
    preset = load_preset("lidargrit_compact_pixels")
    data = replace(preset.data, columns=32, column_stride=1)
    scans = {"tokenizer": 8, "pixels": 4, "transformer": 4}
    few = {
        name: replace(preset.training[name], scans=count, batch_size=2, warmup_scans=0, validate_every=10**6)
        for name, count in scans.items()
    }
    model = replace(LidarGrit.smallest_config(data.load_sensor()), pixels=replace(preset.model.pixels, coarsest_cell=8))
    return replace(preset, model=model, data=data, training=few)


def test_two_legs_from_two_fresh_folders_train_all_stages_in_order(tmp_path):
    first = toy_preset()
    first.training["pixels"] = replace(first.training["pixels"], scans=10**6, checkpoint_every=2)
    Thread(target=terminate_once_there_is, args=[tmp_path / "one" / "pixels" / "checkpoint.safetensors"]).start()
    run_leg(Leg("toy", tmp_path / "one", 10**6, 1, 1), first)
    told = read_json(tmp_path / "one" / RELAY_FILE)
    assert told["finished"] == ["tokenizer"]
    assert told["next_seed"] >= 8
    assert {"tokenizer.kept_poles", "tokenizer.within_5_percent", "pixels.range_bits"} <= told["legs"][0].keys()
    pack(tmp_path / "one", tmp_path / "out")
    unpack(tmp_path / "out", tmp_path / "two")
    second = toy_preset()
    reached = int(told["legs"][0]["pixels.scans"])
    second.training["pixels"] = replace(second.training["pixels"], scans=reached + 4)
    run_leg(Leg("toy", tmp_path / "two", 10**6, 1, 1), second)
    told = read_json(tmp_path / "two" / RELAY_FILE)
    assert told["finished"] == ["tokenizer", "pixels", "transformer"]
    assert len(told["legs"]) == 2
    assert told["legs"][1]["pixels.scans_of_leg"] == 4
    assert "transformer.loss" in told["legs"][1]
    seeds = [{int(path.name[:7]) for path in (tmp_path / run / "streets").glob("*.npy")} for run in ("one", "two")]
    assert seeds[1]
    assert not seeds[0] & seeds[1], "a street was simulated twice"


def terminate_once_there_is(path):
    while not path.exists():
        time.sleep(0.1)
    os.kill(os.getpid(), signal.SIGTERM)


def test_a_folder_of_another_preset_is_refused(half):
    with pytest.raises(OutputError, match="the relay of toy"):
        run_leg(Leg("lidargrit_small", half, 1, 1))


def test_what_travels_leaves_room_for_the_state(tmp_path):
    command = ["bash", "benchmarks/gpu_wheels.sh", str(tmp_path / "wheels")]
    made = subprocess.run(command, check=False, cwd=ROOT, capture_output=True, text=True)
    if "No matching distribution" in made.stderr:
        pytest.skip("no registry of packages is reached")
    assert made.returncode == 0, made.stderr
    tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    tree = sum((ROOT / name).stat().st_size for name in tracked.split("\0") if name and (ROOT / name).is_file())
    wheels = sum(path.stat().st_size for path in (tmp_path / "wheels").glob("*.whl"))
    assert wheels > MIB
    assert tree + wheels < 54 * MIB, json.dumps({"tree": tree, "wheels": wheels})


def test_streets_that_nobody_has_read_yet_are_not_simulated_again(tmp_path):
    streets = Streets(tmp_path)
    assert streets.next_seed(8) == 8
    np.save(tmp_path / "0000000_0000007.npy", np.zeros((1, 4, 8), np.uint16))
    assert streets.count == 1
    np.save(tmp_path / "0000008_0000015.npy", np.zeros((1, 4, 8), np.uint16))
    assert streets.next_seed(8) == 16

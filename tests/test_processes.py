"""Two processes, or a batch taken in parts, against one process with the whole batch."""

import copy
import json
import os
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from lidargrit.core.errors import ConfigError
from lidargrit.core.files import read_tensors
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources import load_range_images
from lidargrit.generation.objective import Objective
from lidargrit.generation.pixel_decoder.phase_noise import PhaseNoise
from lidargrit.generation.pixel_decoder.pixel_phases import phases_of
from lidargrit.generation.presets import load_preset
from lidargrit.generation.settings import TrainingConfig
from lidargrit.generation.tokenizers.vqvae import Vqvae
from lidargrit.nn.collectives import of_first_process
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.systems.multiscale.system import Multiscale
from lidargrit.training.engine import Engine
from lidargrit.training.optimiser import make_optimiser
from lidargrit.training.stage import StageTraining, begin_training
from tiny_runs import train_words

SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(64)

STEADY = [  # no random numbers of a process, only of a scan; codes that restart and follow means; four steps a stage
    "model.tokenizer.dropout=0",
    *[f"model.transformer.{part}_dropout=0" for part in ("embedding", "residual")],
    "training.tokenizer.augmentations=[flip,roll]",
    *[f"training.{stage}.precision=fp32" for stage in ("tokenizer", "transformer")],
    "training.tokenizer.scans=16",
    "training.tokenizer.validate_every=4",
    "training.transformer.scans=32",
    "training.transformer.validate_every=8",
]
RANK = """
import contextlib, io, os, sys
from pathlib import Path
import torch
from lidargrit.cli import main
from test_processes import agreements, learn_noise, learn_pixels, loss_of_pixels, play, steps_with_a_bad_process

folder, words = Path(sys.argv[1]), sys.argv[2:]
assert main(words) == 0
weights, rank = play()
torch.save(weights, folder / f"game{rank}.pt")
assert steps_with_a_bad_process() == [False, False]
assert learn_pixels()
assert agreements(rank) == [True, False]
torch.save(learn_noise(rank), folder / f"noise{rank}.pt")
torch.save(loss_of_pixels(rank, 2), folder / f"pixels{rank}.pt")
assert main([*words, "training.tokenizer.learning_rate=1"]) == 2  # all are told what the first found
if rank == 1:
    os._exit(0)  # dies in the middle of the work, as far as the other can see
with contextlib.redirect_stderr(io.StringIO()) as told:
    assert main([words[0], words[1], str(folder / "alone"), *words[3:]]) == 2
assert "got no answer from another of 2 processes; wanted all of them" in told.getvalue(), told.getvalue()
assert "Traceback" not in told.getvalue()
sys.stdout.flush()
os._exit(0)  # at the end of Python, gloo sometimes aborts a process whose peer has died
"""


class Game(Objective):
    """Two players without any chance, of which each step of one must leave the other alone."""

    players = ("one", "other")

    def __init__(self) -> None:
        super().__init__(SENSOR)
        self.one, self.other = torch.nn.Linear(8, 1), torch.nn.Linear(8, 1)

    def forward(self, example, rng, player):
        seen = example.images.range_m[:, 0, :8] / 10
        error = (
            self.one(seen) - self.other(seen).detach()
            if player == "one"
            else self.other(seen) + seen.sum(1, keepdim=True)
        )
        return {"loss": error.square().mean()}


class Plain(Objective):
    def __init__(self) -> None:
        super().__init__(SENSOR)
        self.linear = torch.nn.Linear(8, 1)

    def forward(self, example, rng, player):
        return {"loss": self.linear(example.images.range_m[:, 0, :8]).mean()}


def some_images(count):
    range_m = torch.rand(count, SENSOR.height, SENSOR.width, generator=torch.Generator().manual_seed(0)) * 50 + 5
    return RangeImage(range_m, torch.ones_like(range_m, dtype=torch.bool), SENSOR)


def play():
    torch.manual_seed(0)
    game, engine = Game(), Engine("fp32", reaches_all_weights=False)
    engine.set_up(game, torch.optim.AdamW(game.parameters(), lr=0.1))
    share = 4 // engine.world_size
    for step in range(5):
        engine.step(Example(some_images(4))[engine.rank * share : (engine.rank + 1) * share], step, gradient_clip=1.0)
    return game.state_dict(), engine.rank


def test_a_batch_queue_is_not_taken_for_a_launcher(monkeypatch):
    for name, value in {"SLURM_NTASKS": "4", "SLURM_JOB_NAME": "train", "SLURM_JOB_ID": "7"}.items():
        monkeypatch.setenv(name, value)
    engine = Engine("fp32")
    assert (engine.rank, engine.world_size) == (0, 1)


def steps_with_a_bad_process():
    """Return whether each of two steps, whose loss is not a number in the second process alone, was finite."""
    plain, engine = Plain(), Engine("fp32")
    engine.set_up(plain, torch.optim.SGD(plain.parameters(), lr=1.0))
    images = some_images(2)
    if engine.rank == 1:
        images = replace(images, range_m=images.range_m.clone())
        images.range_m[0, 0, 0] = torch.nan
    return [bool(engine.step(Example(images), 0, gradient_clip=1.0)["loss"].isfinite()) for _ in range(2)]


def agreements(rank: int) -> list[bool]:
    """Return whether all processes have the same number, of one that they do and one that they do not share."""
    engine = Engine("fp32")
    codes = of_first_process(torch.full((2,), float(rank)))
    assert torch.equal(codes, torch.zeros(2))
    return [engine.same(5_700_001), engine.same(5_700_001 + rank)]


def learn_pixels():
    """Return whether steps of which each reaches some of a pixel decoder's weights alone have moved all networks."""
    torch.manual_seed(0)
    objective = Multiscale(Multiscale.smallest_config(SENSOR), SENSOR).objective("pixels")
    learn = TrainingConfig(scans=8, batch_size=2, learning_rate=1e-3)
    before = copy.deepcopy(objective.state_dict())
    engine, _ = begin_training(objective, learn)
    for step in range(4):
        assert bool(engine.step(Example(some_images(1)), step + engine.rank, gradient_clip=0.0)["loss"].isfinite())
    moved = [name for name, weight in objective.state_dict().items() if not torch.equal(weight, before[name])]
    return len(moved) > len(before) / 2


def learn_noise(rank: int) -> torch.Tensor:
    """Return the sums of a mask's noise, of whose last phases each process learns another."""
    phases = phases_of(2)
    noise = PhaseNoise(phases)
    noise.learn(phases[-1 - rank :][:1], torch.zeros(1, 2, 4, 8), torch.ones(1, 2, 4, 8, dtype=torch.bool))
    return noise.sums


def loss_of_pixels(rank: int, processes: int) -> torch.Tensor:
    """Return the loss of a pixel decoder on a share of four scans, of which the last two have few returns."""
    torch.manual_seed(0)
    objective = Multiscale(Multiscale.smallest_config(SENSOR), SENSOR).objective("pixels").train()
    images, share = some_images(4), 4 // processes
    mask = images.return_mask & (torch.arange(SENSOR.width) % 16 == 0)
    mask[:2] = True
    images = RangeImage.masked(images.range_m, mask, SENSOR)[rank * share : (rank + 1) * share]
    return objective(Example(images), torch.Generator().manual_seed(0), "")["loss"].detach()


def losses(folder: Path, stage: str, name: str) -> list[float]:
    lines = [json.loads(line) for line in (folder / stage / "log.jsonl").read_text().splitlines()]
    return [line[name] for line in lines if line["split"] == "val"]


def launched(processes: int, folder: Path, words: list[str]) -> None:
    """Run as torchrun does."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    common = {
        "WORLD_SIZE": str(processes),
        "MASTER_ADDR": "127.0.0.1",
        "MASTER_PORT": str(port),
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]),
    }
    running = [
        subprocess.Popen(
            [sys.executable, "-c", RANK, str(folder), *words],
            env=os.environ | common | {"RANK": str(rank), "LOCAL_RANK": str(rank)},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for rank in range(processes)
    ]
    outputs = [process.communicate(timeout=280)[0] for process in running]
    assert [process.returncode for process in running] == [0] * processes, "\n".join(outputs)


def test_two_processes_learn_what_one_does(tmp_path):
    """Losses of both stages, the codebook's statistics, a game, a loss that is bad in one process, a refusal."""
    from lidargrit.cli import main

    assert main(train_words(tmp_path / "one", *STEADY)) == 0
    launched(2, tmp_path, train_words(tmp_path / "two", *STEADY))
    for stage, names in (("tokenizer", ("loss", "codebook_perplexity")), ("transformer", ("loss", "unigram_nll"))):
        for name in names:
            one, two = (losses(tmp_path / folder, stage, name) for folder in ("one", "two"))
            assert len(one) >= 4
            assert two == pytest.approx(one, rel=2e-3), (stage, name)
    one, two = (read_tensors(tmp_path / name / "tokenizer" / "checkpoint.safetensors")[0] for name in ("one", "two"))
    assert torch.allclose(one["objective.quantize.usage"], two["objective.quantize.usage"], rtol=0.02, atol=0.5)
    shares = [torch.load(tmp_path / f"pixels{rank}.pt", weights_only=True) for rank in range(2)]
    assert float(sum(shares) / 2) == pytest.approx(float(loss_of_pixels(0, 1)), rel=1e-5)
    assert float(shares[0]) != pytest.approx(float(shares[1]), rel=0.1)
    alone, _ = play()
    for rank in range(2):
        noise = torch.load(tmp_path / f"noise{rank}.pt", weights_only=True)
        assert torch.equal(noise, learn_noise(0) + learn_noise(1)), "each process learns from both"
        together = torch.load(tmp_path / f"game{rank}.pt", weights_only=True)
        assert all(torch.allclose(alone[name], together[name], atol=1e-5) for name in alone)


@pytest.mark.parametrize("parts", [2, 4])
def test_a_batch_in_parts_takes_the_same_step(tmp_path, parts):
    preset = load_preset("lidargrit_demo", train_words(tmp_path)[4:])
    config = DataConfig(train=("simulated:4:train",), columns=512, column_stride=8)
    images = load_range_images(config.train, config)
    sizes = replace(preset.model.tokenizer, dropout=0.0, codebook_loss="paper", restart_dead_codes=False)
    found = []
    for accumulate in (1, parts):
        torch.manual_seed(0)
        vqvae = Vqvae(sizes, images.sensor)
        learn = TrainingConfig(scans=4, batch_size=4, learning_rate=1e-3, accumulate=accumulate, average_over_scans=0)
        optimiser, engine = make_optimiser(vqvae, learn), Engine("fp32")
        engine.set_up(vqvae, optimiser)
        terms = engine.step(Example(images.batch(range(4))), 0, 0.0, accumulate)
        moments = [state["exp_avg"] for state in optimiser.state.values()]
        found.append((float(terms["loss"]), torch.cat([moment.flatten() for moment in moments])))
    assert found[1][0] == pytest.approx(found[0][0], rel=1e-5)
    assert float((found[1][1] - found[0][1]).norm() / found[0][1].norm()) < 1e-4


def test_parts_that_cannot_be_are_refused(tmp_path):
    learn = TrainingConfig(scans=4, batch_size=4, learning_rate=1e-3, accumulate=3)
    with pytest.raises(ConfigError, match="batch_size=4 on 1 processes in 3 parts each; wanted a multiple of 3"):
        StageTraining(Plain(), learn, tmp_path, 0).begun()
    with pytest.raises(ConfigError, match="accumulate=2 for players who take turns"):
        StageTraining(Game(), replace(learn, accumulate=2), tmp_path, 0).begun()
    with pytest.raises(ConfigError, match="accumulate=0"):
        replace(learn, accumulate=0)


def test_a_validation_needs_no_more_memory_than_a_step(tmp_path, monkeypatch):
    config = DataConfig(train=("simulated:4:train",), val=(), columns=512, column_stride=8)
    images = load_range_images(config.train, config)
    learn = TrainingConfig(scans=4, batch_size=4, accumulate=2, learning_rate=1e-3, validation_scans=4)
    vqvae = Vqvae(load_preset("lidargrit_demo", STEADY).model.tokenizer, images.sensor)
    fit = StageTraining(vqvae, learn, tmp_path, 0).begun()
    sizes = []
    monkeypatch.setattr(fit.engine, "evaluate", lambda objective, some, seed: sizes.append(len(some)) or {"loss": 1.0})
    assert fit.validate(images) == {"loss": 1.0}
    assert sizes == [2, 2]

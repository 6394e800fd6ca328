"""Runs that train within a second, and what is read from a command's answer."""

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import TypeVar

import torch
from torch import nn

from lidargrit.generation.objective import Objective
from lidargrit.scans.condition import Observed
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage
from lidargrit.systems.completion.network import CompletionNetworkConfig
from lidargrit.systems.completion.system import Completion, CompletionConfig
from lidargrit.systems.lidargrit.system import LidarGrit
from lidargrit.systems.raydrop.network import RaydropNetworkConfig
from lidargrit.systems.raydrop.system import Raydrop, RaydropConfig

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
LONG = [  # 6 and 4 steps on 64x32 images, a checkpoint after each
    "data.column_stride=16",
    "training.tokenizer.scans=24",
    "training.tokenizer.checkpoint_every=4",
    "training.transformer.scans=32",
    "training.transformer.checkpoint_every=8",
]
PROGRESS = re.compile(
    r"(projecting scans|training \w+|sampling): \d+/\d+|  after \d+ scans|\s*WARNING: |left out: |lidargrit demo: "
    r"about |timing some steps of training|the model in the package is of another sensor|"
    r"The tokenizer, .* learn anew here|"
    r".*: no sensor is named, so "
)


NetworkT = TypeVar("NetworkT", bound=nn.Module)


def with_random_weights(network: NetworkT, seed: int = 3) -> NetworkT:
    """Draw all weights, also those that begin at zero, so that outputs differ from pixel to pixel."""
    rng = torch.Generator().manual_seed(seed)
    for weight in network.parameters():
        weight.data = torch.empty_like(weight).normal_(std=0.1, generator=rng)
    return network


def train_words(folder: Path, *settings: str) -> list[str]:
    return ["train", "lidargrit_demo", str(folder), "--set", *MODEL, *SIMULATED, *SHORT, *settings]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def the_one_line(stderr: str, verb: str) -> str:
    """Return the error among the lines on stderr, having checked that it is one line with its three parts."""
    lines = [line for line in stderr.splitlines() if not PROGRESS.match(line)]
    assert len(lines) == 1, stderr
    assert re.fullmatch(rf"lidargrit {verb}: got \S.*; wanted \S.*; \S.*", lines[0]), stderr
    return lines[0]


def learn(objective: Objective, images: RangeImage, seeds: Iterable[int], learning_rate: float) -> list[dict]:
    """Take a step of Adam on the same scans for each seed, and return the terms of every step."""
    optimiser = torch.optim.Adam(objective.parameters(), lr=learning_rate)
    found = []
    for seed in seeds:
        terms = objective(Example(images), torch.Generator().manual_seed(seed))
        optimiser.zero_grad()
        terms["loss"].backward()
        optimiser.step()
        found.append({name: float(term.detach()) for name, term in terms.items()})
    return found


def every_fourth_row(images: RangeImage) -> Observed:
    """Return what is known of scans whose every fourth row is observed."""
    observed = torch.zeros_like(images.return_mask)
    observed[:, 2::4] = True
    return Observed.of_pixels(images, observed)


def save_bundle(
    folder: Path,
    sensor: SensorModel,
    completion: CompletionNetworkConfig | None = None,
    raydrop: RaydropNetworkConfig | None = None,
) -> None:
    """Write a bundle of untrained runs: the smallest LidarGRIT, and of completion and raydrop those with a network."""
    runs = {"sample": "lidargrit"}
    LidarGrit(LidarGrit.smallest_config(sensor), sensor).save(folder / "lidargrit")
    if completion is not None:
        Completion(CompletionConfig(completion), sensor).save(folder / "completion")
        runs["complete"] = "completion"
    if raydrop is not None:
        Raydrop(RaydropConfig(raydrop), sensor).save(folder / "raydrop")
        runs["raydrop"] = "raydrop"
    (folder / "bundle.json").write_text(json.dumps(runs))

"""A generator in training → a PNG of real scans, their reconstructions and new scans."""

from pathlib import Path

import torch

from lidargrit.core.determinism import evenly_spaced
from lidargrit.data.images import RangeImages
from lidargrit.generation.generator import Generator
from lidargrit.scans.condition import Nothing
from lidargrit.viewer.pictures import plot_comparison

_SCANS = 2  # a glance; more would take training's time


@torch.no_grad()
def plot_progress(generator: Generator, stage: str, val: RangeImages, path: Path) -> None:
    """Plot validation scans, their reconstructions, and new scans once more than a tokenizer is in training."""
    real = val.batch(evenly_spaced(_SCANS, len(val)))
    groups = {"val": real}
    if "encode" in generator.capabilities:
        groups["reconstructed"] = generator.reconstruct(real).to("cpu")
    samples = stage != generator.stages[0] or len(generator.stages) == 1
    if samples and Nothing in generator.takes:
        groups["generated"] = generator.sample(range(_SCANS)).to("cpu")
    plot_comparison(groups, path, title=f"{stage}, {path.stem} scans seen")

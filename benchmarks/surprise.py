"""How well bits tell what does not belong in a scan: simulated scans, changed in known pixels → areas under ROC curves.

    python benchmarks/surprise.py --scans simulated:24:test --json surprise.json

Each scan is changed in four ways: a ball that floats, dirt on the window, rain-like returns, and a sensor that is
turned about its lateral axis. The first two are found by cells of 8x8 pixels, rain by pixels, a turned sensor by whole
scans: the area is the probability that what was changed has a higher score than what was not. The scores are the bits
of a cell's token, the bits of its pixels beyond those expected, all bits, and the error of reconstruction: how far a
return is from the decoded range, in ln(1 + range), and how unlikely its mask was by the tokenizer's decoder.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from scipy.stats import rankdata
from torch import Tensor

from lidargrit.files import write_json
from lidargrit.generators import Generator, load
from lidargrit.loading import DataConfig
from lidargrit.sources import open_images
from lidargrit.structures import RangeImage

CELL = 8
Changed = tuple[RangeImage, Bool[Tensor, "1 H W"]]


@dataclass(frozen=True)
class Change:
    """One way of changing a scan.

    Args:
        make: function from a scan (1, H, W) and random numbers to the changed scan and its changed pixels.
        unit: what is found by it: pixels, cells or whole scans.
    """

    make: Callable[[RangeImage, torch.Generator], Changed]
    unit: str


def ball(image: RangeImage, rng: torch.Generator) -> Changed:
    """Put a ball of 1 m radius into the air, 6 to 15 m away, its centre up to 0.8 m above the sensor or below."""
    away, turn, up = torch.rand(3, generator=rng)
    angle, distance = 2 * torch.pi * turn, 6 + 9 * away
    centre = torch.stack((distance * angle.cos(), distance * angle.sin(), 1.6 * up - 0.8))
    along = image.sensor.ray_directions() @ centre
    inside = 1 - (centre.square().sum() - along.square())
    hit = (inside > 0) & (along > 0)
    range_m = along - inside.clamp(min=0).sqrt()
    hit = (hit & ((range_m < image.range_m[0]) | ~image.return_mask[0]))[None]
    return _with(image, torch.where(hit, range_m, image.range_m), image.return_mask | hit), hit


def dirt(image: RangeImage, rng: torch.Generator) -> Changed:
    """Cover three round spots of the window, through which no ray comes back."""
    height, width = image.range_m.shape[1:]
    rows, columns = torch.arange(height)[:, None], torch.arange(width)
    covered = torch.zeros(1, height, width, dtype=torch.bool)
    for row, column, radius in torch.rand(3, 3, generator=rng).tolist():
        sideways = (columns - column * width + width / 2) % width - width / 2
        covered |= (rows - row * height) ** 2 + sideways**2 < (4 + 4 * radius) ** 2
    changed = covered & image.return_mask
    return _with(image, image.range_m, image.return_mask & ~covered), changed


def rain(image: RangeImage, rng: torch.Generator) -> Changed:
    """Let one ray in a hundred return from a drop, anywhere from 1.5 m to 15 m before its surface."""
    uniform = torch.rand(2, *image.range_m.shape, generator=rng)
    range_m = 1.5 + 13.5 * uniform[1]
    hit = (uniform[0] < 0.01) & ((range_m < image.range_m) | ~image.return_mask)
    return _with(image, torch.where(hit, range_m, image.range_m), image.return_mask | hit), hit


def turned(image: RangeImage, rng: torch.Generator) -> Changed:
    """Turn the sensor by 3 degrees about its lateral axis: each ray sees what lay on the nearest ray before."""
    angle = torch.tensor(3.0).deg2rad()
    rays = image.sensor.ray_directions()
    x, y, z = rays.unbind(-1)
    x, z = x * angle.cos() + z * angle.sin(), z * angle.cos() - x * angle.sin()
    rows = (z.asin()[..., None] - image.sensor.elevation_rad.mean(1)).abs().argmin(-1)
    width = image.range_m.shape[-1]
    columns = (((torch.pi - torch.atan2(y, x)) / (2 * torch.pi) * width).floor().long()) % width
    range_m = image.range_m[0, rows, columns][None]
    return _with(image, range_m, range_m > 0), torch.ones_like(image.return_mask)


CHANGES = {
    "a floating ball": Change(ball, "cells"),
    "dirt on the window": Change(dirt, "cells"),
    "rain": Change(rain, "pixels"),
    "turned by 3 degrees": Change(turned, "scans"),
}


def _with(image: RangeImage, range_m: Tensor, mask: Tensor) -> RangeImage:
    return RangeImage.masked(range_m.float(), mask, image.sensor)


def scores(generator: Generator, image: RangeImage) -> dict[str, Float[Tensor, "1 H W"]]:
    """Return what each way gives a pixel: the higher, the less it belongs there."""
    decoded = generator.get_tokenizer().decode(generator.get_tokenizer().encode(image))
    error = (decoded.range_m.log1p() - image.range_m.log1p()).abs() * image.return_mask
    missed = F.binary_cross_entropy_with_logits(decoded.return_logits, image.return_mask.float(), reduction="none")
    bits = generator.bits(image, expected=True)
    tokens = bits.tokens.repeat_interleave(CELL, 1).repeat_interleave(CELL, 2)
    return {
        "bits of tokens": tokens,
        "bits of pixels beyond those expected": bits.surprise(),
        "all bits": bits.per_pixel(),
        "error of reconstruction": error + missed,
    }


def by_unit(score: Tensor, unit: str) -> Tensor:
    """Return one number for each pixel, cell or scan: the mean."""
    if unit == "pixels":
        return score.flatten()
    return F.avg_pool2d(score[:, None].float(), CELL).flatten() if unit == "cells" else score.float().mean()[None]


def area(changed: Tensor, others: Tensor) -> float:
    """Return the area under the ROC curve: the probability that a changed one scores higher than another."""
    ranks = rankdata(torch.cat((changed, others)).double().numpy())
    return float((ranks[: len(changed)].sum() / len(changed) - (len(changed) + 1) / 2) / len(others))


@torch.no_grad()
def main() -> None:
    """Change every scan in every way, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", default="simulated:24:test")
    parser.add_argument("--model", default="pretrained")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    generator = load(options.model).eval()
    images = open_images(options.scans, generator.sensor, DataConfig())
    found: dict[tuple[str, str], tuple[list[Tensor], list[Tensor]]] = {}
    for index in range(len(images)):
        whole = images.batch([index])
        before = scores(generator, whole)
        for name, change in CHANGES.items():
            image, pixels = change.make(whole, torch.Generator().manual_seed(index))
            at = by_unit(pixels, change.unit) >= (0.25 if change.unit == "cells" else 1)
            for way, score in scores(generator, image).items():
                changed, others = found.setdefault((name, way), ([], []))
                changed.append(by_unit(score, change.unit)[at])
                others.append(by_unit(before[way], change.unit))
    rows = [
        {"change": name, "score": way, "unit": CHANGES[name].unit, "area": area(torch.cat(changed), torch.cat(others))}
        for (name, way), (changed, others) in found.items()
    ]
    for row in rows:
        print(f"| {row['change']} | {row['unit']} | {row['score']} | {row['area']:.3f} |", flush=True)
    if options.json:
        write_json(options.json, rows)


if __name__ == "__main__":
    main()

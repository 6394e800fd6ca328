"""How well bits tell what does not belong in a scan: simulated scans, changed in known pixels → areas under ROC curves.

    python benchmarks/anomaly.py --scans simulated:24:test --json anomaly.json

Each scan is changed in five ways: a block that lies askew in the street, put in by the simulator where the scans are
simulated; a ball that floats; dirt on the window; rain-like returns; and a sensor turned about its lateral axis. The
first three are found by cells of 8x8 pixels, rain by pixels, a turned sensor by whole scans: the area is the
probability that what was changed has a higher score than what was not. The scores are the bits of a cell's token, the
bits of its pixels beyond those expected, all bits, and the error of reconstruction: how far a return is from the
decoded range, in ln(1 + range), and how unlikely its mask was by the tokenizer's decoder. `--diffusion RUN` adds the
residual of an R2DM without reflectance: how far its clean image lies from the scan to which noise was added.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from lidargrit.core.files import write_json
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources import open_images
from lidargrit.evaluation.intervals import Estimate
from lidargrit.generation.generator import Generator, load
from lidargrit.generation.range_values import encode
from lidargrit.nn.random import SeededNoise
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage
from lidargrit.simulator.mesh import Mesh
from lidargrit.simulator.observation import ObservationConfig, observe_scene
from lidargrit.simulator.scene import sample_scene
from lidargrit.simulator.scene.shapes import boxes
from lidargrit.systems.r2dm.diffusion import alpha_sigma, log_snr_at, noised
from lidargrit.systems.r2dm.system import R2dm

CELL = 8
_BLOCK = "a block askew in the street"
_NOISE_TIMES, _NOISE_DRAWS = (0.3, 0.5, 0.7), 2  # of 0, clean, to 1, noise; and how often each, for the residual
_OTHER_OBJECT = 99  # SemanticKITTI's number; no street has any
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


def with_block(seed: int, sensor: SensorModel, rng: torch.Generator) -> Changed:
    """Simulate a street again with a block of 2.5 x 1.2 x 1.2 m in it, turned at random, 6 to 15 m away."""
    away, turn, *axis = torch.rand(5, generator=rng).tolist()
    low, high = (np.array([[sign * 1.25, sign * 0.6, sign * 0.6]]) for sign in (-1, 1))
    turned_by = Rotation.from_rotvec(2 * np.pi * (np.array(axis) - 0.5)).as_matrix()
    angle, distance_m = 2 * np.pi * turn, 6 + 9 * away
    centre = np.array([distance_m * np.cos(angle), distance_m * np.sin(angle), 0.9])
    corners = boxes(low, high)[0] @ turned_by.T + centre
    scene_rng, beam_rng = np.random.default_rng(seed).spawn(2)  # as in simulate
    scene = sample_scene(scene_rng, "mixed")
    block = Mesh.of(corners, material=int(scene.standing.material[0]), albedo=0.5, label=_OTHER_OBJECT)
    scene = replace(scene, standing=Mesh.join([scene.standing, block]))
    seen = observe_scene(scene, sensor, scene_rng, beam_rng, ObservationConfig(kept_columns_only=True))
    mask = torch.from_numpy(seen.return_mask)[None]
    changed = torch.from_numpy(seen.label == _OTHER_OBJECT)[None] & mask
    return RangeImage.masked(torch.from_numpy(seen.range_m)[None], mask, sensor), changed


CHANGES = {
    "a floating ball": Change(ball, "cells"),
    "dirt on the window": Change(dirt, "cells"),
    "rain": Change(rain, "pixels"),
    "turned by 3 degrees": Change(turned, "scans"),
}


def _with(image: RangeImage, range_m: Tensor, mask: Tensor) -> RangeImage:
    return RangeImage.masked(range_m.float(), mask, image.sensor)


def scores(generator: Generator, diffusion: R2dm | None, image: RangeImage) -> dict[str, Float[Tensor, "1 H W"]]:
    """Return what each way gives a pixel: the higher, the less it belongs there."""
    decoded = generator.get_tokenizer().decode(generator.get_tokenizer().encode(image))
    error = (decoded.range_m.log1p() - image.range_m.log1p()).abs() * image.return_mask
    missed = F.binary_cross_entropy_with_logits(decoded.return_logits, image.return_mask.float(), reduction="none")
    bits = generator.bits(image, expected=True)
    tokens = bits.tokens.repeat_interleave(CELL, 1).repeat_interleave(CELL, 2)
    return {
        "bits of tokens": tokens,
        "bits of pixels beyond those expected": bits.anomaly(),
        "all bits": bits.per_pixel(),
        "error of reconstruction": error + missed,
        **({} if diffusion is None else {"residual of R2DM": residual(diffusion, image)}),
    }


def residual(diffusion: R2dm, image: RangeImage) -> Float[Tensor, "1 H W"]:
    """Return how far what R2DM makes of noisy copies lies from the scan, in its log ranges: the mean over copies."""
    clean, noise = encode(image, with_reflectance=False), SeededNoise([0], diffusion.shape, diffusion.device)
    errors = []
    for time in _NOISE_TIMES * _NOISE_DRAWS:
        log_snr = log_snr_at(torch.tensor([time]))
        alpha, sigma = alpha_sigma(log_snr)
        noisy = noised(clean, log_snr, noise())
        errors.append((((noisy - sigma * diffusion.network(noisy, log_snr)) / alpha).clamp(-1, 1) - clean).abs())
    return torch.stack(errors).mean(0)[:, 0]


def by_unit(score: Tensor, unit: str) -> Tensor:
    """Return one number for each pixel, cell or scan: the mean."""
    if unit == "pixels":
        return score.flatten()
    return F.avg_pool2d(score[:, None].float(), CELL).flatten() if unit == "cells" else score.float().mean()[None]


def area(changed: list[Tensor], others: list[Tensor]) -> Estimate:
    """Return the area under the ROC curve: the probability that a changed one scores higher than another.

    The interval is over scans with changes; what was left as it was counts as known.
    """
    left = torch.cat(others).double().sort().values.numpy()
    scans = [each.double().numpy() for each in changed if len(each)]
    higher = [(np.searchsorted(left, each) + np.searchsorted(left, each, "right")).sum() / 2 for each in scans]
    return Estimate.of_ratio([float(each) / len(left) for each in higher], [float(len(each)) for each in scans])


@torch.no_grad()
def main() -> None:
    """Change every scan in every way, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", default="simulated:24:test")
    parser.add_argument("--model", default="pretrained")
    parser.add_argument("--diffusion", metavar="RUN", help="finished run of R2DM without reflectance")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    generator, diffusion = load(options.model).eval(), load(options.diffusion).eval() if options.diffusion else None
    assert diffusion is None or (isinstance(diffusion, R2dm) and not diffusion.config.reflectance), options.diffusion
    images = open_images(options.scans, generator.sensor, DataConfig())
    found: dict[tuple[str, str], tuple[list[Tensor], list[Tensor]]] = {}
    for index in range(len(images)):
        whole = images.batch([index])
        before = scores(generator, diffusion, whole)
        changes = dict(CHANGES)
        if options.scans.startswith("simulated:"):
            seed = int(images.provenance.names[index].rpartition("_")[2])
            changes[_BLOCK] = Change(lambda image, rng, seed=seed: with_block(seed, image.sensor, rng), "cells")
        for name, change in changes.items():
            image, pixels = change.make(whole, torch.Generator().manual_seed(index))
            at = by_unit(pixels, change.unit) >= (0.25 if change.unit == "cells" else 1)
            for way, score in scores(generator, diffusion, image).items():
                changed, others = found.setdefault((name, way), ([], []))
                changed.append(by_unit(score, change.unit)[at])
                others.append(by_unit(before[way], change.unit))
    rows = []
    for (name, way), (changed, others) in found.items():
        unit, told = CHANGES[name].unit if name in CHANGES else "cells", area(changed, others)
        rows.append(
            {"change": name, "score": way, "unit": unit, "area": told.value, "low": told.low, "high": told.high}
        )
        print(f"| {name} | {unit} | {way} | {told.value:.3f} [{told.low:.3f}, {told.high:.3f}] |", flush=True)
    if options.json:
        write_json(options.json, rows)


if __name__ == "__main__":
    main()

"""Which phases of a pixel decoder make walls ragged: scans sampled around true pixels of the coarse phases → scores.

    python benchmarks/coarse_phases.py pretrained -n 96

Scans are encoded, and their pixels sampled from the true tokens, around none or some of their true pixels: those of the
first so many phases. What a score gains from one line to the next is what those phases cost. Scans are compared with
others than those that are encoded.
"""

import argparse
from collections.abc import Sequence

import torch

from lidargrit.data.sources import open_images
from lidargrit.evaluation.metrics import load_metric, update_together
from lidargrit.generation.generator import load
from lidargrit.generation.pixel_decoder.pixel_decoder import PixelDecoder, PixelSampling
from lidargrit.generation.pixel_decoder.pixel_phases import Lattice, completed_lattices
from lidargrit.generation.tokenizers import Tokenizer
from lidargrit.scans.condition import Observed
from lidargrit.scans.types import RangeImage
from lidargrit.systems.lidargrit.system import LidarGrit

METRICS = ("wall_straightness", "flying_points", "drop_run_lengths", "drop_correlation", "point_cloud_jsd")
_AT_ONCE, _LATTICES = 8, 4


def around_true_pixels(
    tokenizer: Tokenizer,
    pixels: PixelDecoder,
    images: RangeImage,
    given: Lattice | None,
    sampling: PixelSampling,
    seed: int,
) -> RangeImage:
    """Return scans sampled from the tokens of others, with the true pixels of a lattice given."""
    found = []
    for first in range(0, len(images), _AT_ONCE):
        some = images[first : first + _AT_ONCE]
        observed = torch.zeros_like(some.return_mask)
        if given is not None:
            observed[(..., *given.pixels)] = True
        rngs = [torch.Generator().manual_seed(seed + first + index) for index in range(len(some))]
        decoded = tokenizer.decode(tokenizer.encode(some))
        found.append(pixels.sample(decoded, rngs, sampling, Observed.of_pixels(some, observed)))
    return RangeImage.cat(found)


def scores(images: RangeImage, others: RangeImage) -> list[float]:
    """Return the scores of scans by every metric of the table, and the share of far neighbours in percent."""
    metrics = [load_metric(name)() for name in METRICS]
    update_together([(metric, False) for metric in metrics], images)
    update_together([(metric, True) for metric in metrics], others)
    both = images.return_mask & images.return_mask.roll(-1, -1)
    far = (images.range_m - images.range_m.roll(-1, -1)).abs() > 2
    return [metric.compute().value for metric in metrics] + [100 * float(far[both].float().mean())]


def main(words: Sequence[str] | None = None) -> None:
    """Print one line for each of the finest lattices of given pixels."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", help="a run with tokens and a pixel decoder")
    parser.add_argument("--scans", default="simulated:256:val", help="source of scans (default: %(default)s)")
    parser.add_argument("-n", type=int, default=96, help="number of scans, and of others to compare with")
    parser.add_argument(
        "--range-temperature", type=float, default=PixelSampling.range_temperature, help="0: the model's own"
    )
    parser.add_argument("--range-noise", type=float, default=PixelSampling.range_noise)
    choices = parser.parse_args(words)
    model = load(choices.model)
    if not isinstance(model, LidarGrit) or model.pixels is None:
        parser.error(f"{choices.model} has no tokens and pixel decoder, choose a run of lidargrit_compact_pixels")
    images = open_images(choices.scans, sensor=model.sensor)
    if len(images) < 2 * choices.n:
        parser.error(f"{choices.scans} has {len(images)} scans, wanted twice {choices.n}, choose a lower -n")
    others, scored = images.batch(range(choices.n)), images.batch(range(choices.n, 2 * choices.n))
    sampling = PixelSampling(choices.range_temperature, choices.range_noise)
    print(f"{'true pixels given':28}", *(f"{name:>18}" for name in (*METRICS, "> 2 m apart, %")))
    lattices = completed_lattices(model.pixels.mask.phases)[-_LATTICES:]
    for lattice, phases in [(None, 0), *lattices]:
        with torch.inference_mode():
            sampled = around_true_pixels(model.tokenizer, model.pixels, scored, lattice, sampling, seed=900_000)
        title = "none" if lattice is None else f"one in {lattice.rows} x {lattice.columns}: {phases} phases"
        print(f"{title:28}", *(f"{value:18.4f}" for value in scores(sampled, others)), flush=True)


if __name__ == "__main__":
    main()

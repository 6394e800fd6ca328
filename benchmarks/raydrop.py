"""A model's raydrop of clean test streets beside the simulator's own and independent drops → a Markdown table.

    python benchmarks/raydrop.py runs/dropping -n 128
    python benchmarks/raydrop.py runs/dropping -n 32 --real /data/kitti_odometry

The true scans are those of ``simulated:512:test``: the first N to drop returns of, and as many others for the distance
between two sets of true scans. `pixel by pixel` takes the probabilities of the model's network of raydrop, but samples
each return independently of the others. The simulator draws its noise from pulse to pulse anew, and knows the rest.

A network with reflectance gets a second table: the mean absolute error over pixels that return in the model's and in
the true scan, beside that of one number for all returns or for each class, which are those of the other test streets.
`--real` asks the same of real scans, whose surfaces are their own returns.
"""

import argparse
import copy

import torch

from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources import open_images
from lidargrit.evaluation.raydrop import RAYDROP_CURVES
from lidargrit.evaluation.realism import batches, distance, drop_independently, pair_of
from lidargrit.generation.generator import load
from lidargrit.scans.condition import Observed
from lidargrit.scans.planes import planes_of
from lidargrit.scans.types import RangeImage
from lidargrit.simulator import observe
from lidargrit.systems.raydrop.system import Raydrop

_FIRST_TEST_SEED = 2_000_000


def main() -> None:
    """Simulate, drop, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", help="run with a network of raydrop, or pretrained")
    parser.add_argument("-n", "--count", type=int, default=128, help="number of streets")
    parser.add_argument("--real", default="", help="source of real scans, whose reflectance is estimated, too")
    options = parser.parse_args()
    model = load(options.run, "raydrop")
    assert isinstance(model, Raydrop), "a run of raydrop"
    clean, true, redrawn = [], [], []
    rng = torch.Generator().manual_seed(0)
    for seed in range(_FIRST_TEST_SEED, _FIRST_TEST_SEED + 2 * options.count):
        seen = observe(seed, model.sensor, kept_columns_only=True)
        of_clean, of_true = pair_of(seen, model.sensor)
        again = torch.rand(of_clean.range_m.shape, generator=rng) < torch.from_numpy(seen.return_probability)
        clean.append(of_clean)
        true.append(of_true)
        redrawn.append(RangeImage.masked(of_clean.range_m, of_clean.return_mask & again, model.sensor))
    surfaces, others = RangeImage.stack(clean[: options.count]), RangeImage.stack(true[options.count :])
    measured = RangeImage.stack(true[: options.count])
    dropped = model.complete(Observed.of_surfaces(surfaces), range(options.count))
    independent = copy.deepcopy(model)
    independent.raydrop.mask.noise.sums.zero_()
    with torch.no_grad():
        every = [surfaces[index : index + 1] for index in range(options.count)]
        logits = torch.cat([model.raydrop(one.range_m, one.return_mask, one.label).logits for one in every])
    alone = surfaces.return_mask & (torch.rand(logits.shape, generator=rng) < logits.sigmoid())
    rows = {
        "true scans of the same streets": measured,
        "the simulator, sampled again": RangeImage.stack(redrawn[: options.count]),
        "model": dropped,
        "model, pixels of a phase independent": independent.complete(
            Observed.of_surfaces(surfaces), range(options.count)
        ),
        "its probabilities, pixel by pixel": RangeImage.masked(surfaces.range_m, alone, model.sensor),
        "Bernoulli": drop_independently(surfaces, float(measured.return_mask.float().mean())),
    }
    print("| drops by | " + " | ".join(RAYDROP_CURVES) + " |\n|---" + "|---" * len(RAYDROP_CURVES) + "|")
    for name, images in rows.items():
        values = [distance(curve, batches(images), batches(others)).value for curve in RAYDROP_CURVES]
        print(f"| {name} | " + " | ".join(f"{value:.4f}" for value in values) + " |")
    if dropped.reflectance is not None:
        print("\nreflectance of the streets\n" + reflectance_table(dropped, measured, others))
        if options.real:
            real = open_images(options.real, model.sensor, DataConfig(bad_points="drop"))
            true = real.batch(range(len(real)))
            again = model.complete(Observed.of_surfaces(true), range(len(true)))
            print("\nreflectance of real scans\n" + reflectance_table(again, true, others))


def reflectance_table(found: RangeImage, true: RangeImage, others: RangeImage) -> str:
    """Return errors of reflectance, and distances of its histogram from that of the true scans, as Markdown.

    Args:
        found: scans with the model's reflectance.
        true: the same scans with the true one.
        others: scans from which means and medians are taken.
    """
    estimates = {"model": found.reflectance}
    for name, middle in (("mean", torch.mean), ("median", torch.median)):
        of_all = torch.full_like(true.range_m, float(middle(_values(others, others.return_mask))))
        estimates[f"{name} of simulated returns"] = of_all
        if true.label is not None and others.label is not None:
            of_class = of_all.clone()
            for number in others.label[others.return_mask].unique():
                chosen = others.return_mask & (others.label == number)
                of_class[true.label == number] = float(middle(_values(others, chosen)))
            estimates[f"{name} of the class"] = of_class
        own = torch.full_like(true.range_m, float(middle(_values(true, true.return_mask))))
        estimates[f"{name} of these very returns"] = own
    both, lines = (
        found.return_mask & true.return_mask,
        ["| reflectance | error | reflectance_histogram |", "|---|---|---|"],
    )
    for name, reflectance in estimates.items():
        assert reflectance is not None
        error = float((reflectance[both] - _values(true, both)).double().abs().mean())
        image = RangeImage.masked(true.range_m, both, true.sensor, planes_of(reflectance=reflectance))
        found = distance("reflectance_histogram", batches(image), batches(true))
        lines.append(f"| {name} | {error:.4f} | {found.value:.4f} |")
    found = distance("reflectance_histogram", batches(others), batches(true))
    lines.append(f"| other streets |  | {found.value:.4f} |")
    return "\n".join(lines)


def _values(images: RangeImage, chosen: torch.Tensor) -> torch.Tensor:
    assert images.reflectance is not None
    return images.reflectance[chosen]


if __name__ == "__main__":
    main()

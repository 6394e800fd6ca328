"""What three metrics say of real scans, of learned ones, and of scans spoiled in known ways → reference_rows.png."""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import torch

import lidargrit
from lidargrit.evaluation.metrics import load_metric
from lidargrit.scans.types import RangeImage

METRICS = ("bev_jsd", "range_histogram_per_ring", "drop_run_lengths")
COUNT = 16  # scans of each set: few, so that this takes seconds; score thousands


def main(folder: Path) -> None:
    """Score five sets against one reference, print a table and plot it."""
    reference, others, train = (scans(first) for first in (0, 1000, 2000))
    rng = torch.Generator().manual_seed(0)
    pixel = torch.randint(COUNT, train.range_m.shape, generator=rng)  # each pixel from another scan: no shapes at all
    coin = torch.rand(others.range_m.shape, generator=rng) < 0.8
    lossy = RangeImage.masked(others.range_m, others.return_mask & coin, others.sensor)
    far = RangeImage.masked(others.range_m * 1.05, others.return_mask, others.sensor)
    sets = {
        "other real scans: real against real": others,
        "memorised training scans": train,
        "every fifth return lost by a coin": lossy,
        "everything 5 % too far": far,
        "each pixel from another scan: pixel statistics": shuffled(train, pixel),
    }
    values = {name: [score(metric, images, reference) for metric in METRICS] for name, images in sets.items()}
    for name, row in values.items():
        print(f"{name:<50}" + "".join(f"{value:>9.4f}" for value in row))

    figure, axes = plt.subplots(1, len(METRICS), figsize=(11, 3), sharey=True, layout="constrained")
    for number, (axis, metric) in enumerate(zip(axes, METRICS, strict=True)):
        bars = [row[number] for row in values.values()]
        axis.barh(list(values), bars, color=["#999999", *["#3b6ea5"] * 3, "#b03030"])
        axis.axvline(bars[0], color="#999999", linestyle=":")
        axis.set_title(metric, fontsize=10)
        axis.set_xlabel("lower is better")
    axes[0].invert_yaxis()
    figure.savefig(folder / "reference_rows.png", dpi=100, metadata={"Software": None})
    plt.close(figure)


def scans(first_seed: int) -> RangeImage:
    """Return range images of streets; here simulated ones stand for real ones."""
    sensor = lidargrit.load_sensor("hdl64e_kitti_odometry")
    found = [lidargrit.simulate(first_seed + i, sensor, kept_columns_only=True) for i in range(COUNT)]
    return RangeImage.stack([lidargrit.project(scan, sensor) for scan in found])


def shuffled(images: RangeImage, pixel: torch.Tensor) -> RangeImage:
    """Return images that take each pixel from the scan that ``pixel`` names."""
    return RangeImage.masked(images.range_m.gather(0, pixel), images.return_mask.gather(0, pixel), images.sensor)


def score(name: str, generated: RangeImage, real: RangeImage) -> float:
    """Return one number."""
    metric = load_metric(name)()
    metric.update(generated, real=False)
    metric.update(real, real=True)
    return metric.compute().value


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "docs/pictures"))

"""What the projection alone does to a score: the same scans by two projections, without any model.

    python benchmarks/projection_confound.py SOURCE [SOURCE ...]

*Direct* goes straight to 1024 columns and floors, as R2DM's and LiDARGen's programs do; *subsampled* rounds to 2048 and
keeps every second column, as LidarGRIT's does. The even scans stand for samples, the odd ones for the reference.
"""

import argparse

import torch

from lidargrit.data.datasets import open_dataset
from lidargrit.evaluation.metrics import load_metric
from lidargrit.scans.projection import project
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage

METRICS = {
    "sliced_wasserstein": "reference",
    "bev_jsd": "lidargrit",
    "bev_mmd": "lidargrit",
    "point_cloud_jsd": "exact",
    "minimum_matching_distance": "exact",
    "return_rate_per_ring": "exact",
}
DIRECT = load_sensor("hdl64e_kitti_360")


def images_of(sources: list[str]) -> dict[str, RangeImage]:
    """Return all scans of the sources by both projections, as images of one sensor: only pixels are compared."""
    scans = [dataset.scan(i) for dataset in map(open_dataset, sources) for i in range(len(dataset))]
    fine = DIRECT.with_columns(2048, 2)
    direct = RangeImage.stack([project(scan, DIRECT, "spherical") for scan in scans])
    kept = RangeImage.stack([project(scan, fine, "spherical", "reference") for scan in scans])
    return {"direct": direct, "subsampled": RangeImage(kept.range_m, kept.return_mask, DIRECT)}


def score(name: str, generated: RangeImage, real: RangeImage) -> float:
    """Return one number."""
    metric = load_metric(name)(variant=METRICS[name])
    metric.update(generated, real=False)
    metric.update(real, real=True)
    return metric.compute().value


def main() -> None:
    """Print the shares of filled pixels and a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="+", metavar="SOURCE")
    parser.add_argument("--metrics", nargs="+", choices=METRICS, default=[*METRICS])
    options = parser.parse_args()
    torch.set_num_threads(1)
    images = images_of(options.sources)
    direct, kept = images["direct"], images["subsampled"]
    even, odd = slice(0, len(direct) // 2 * 2, 2), slice(1, None, 2)  # equally many
    filled = ", ".join(f"{name} {float(of.return_mask.float().mean()):.1%}" for name, of in images.items())
    print(f"{len(direct)} scans; pixels filled: {filled}\n")
    print(f"{'metric':<28}{'both direct':>14}{'both subsampled':>17}{'one of each':>14}{'same scans':>14}")
    for name in options.metrics:
        pairs = (
            (direct[even], direct[odd]),
            (kept[even], kept[odd]),
            (direct[even], kept[odd]),
            (direct[even], kept[even]),
        )
        cells = [score(name, *pair) for pair in pairs]
        print(f"{name:<28}{cells[0]:>14.4g}{cells[1]:>17.4g}{cells[2]:>14.4g}{cells[3]:>14.4g}", flush=True)


if __name__ == "__main__":
    main()

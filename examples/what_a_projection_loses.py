"""One scan in four range images, and what each makes of its points → what_a_projection_loses.png."""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.colors import LogNorm

import lidargrit

WAYS = {
    "by ring, every column that the sensor fires": ("hdl64e_kitti_odometry", 2048),
    "by ring, 1,024 columns": ("hdl64e_kitti_odometry", 1024),
    "by elevation, 64 equal rows, 1,024 columns": ("hdl64e_kitti_360", 1024),
    "by elevation, 32 rows of another sensor": ("vlp32c", 1024),
}


def main(folder: Path) -> None:
    """Inspect the scan in four ways, and plot of each the part straight ahead."""
    scan = lidargrit.simulate(seed=8)  # the HDL-64E, whose rows are not equally far apart
    figure, axes = plt.subplots(len(WAYS), figsize=(10, 6.4), layout="constrained")
    for axis, (way, (name, columns)) in zip(axes, WAYS.items(), strict=True):
        found = lidargrit.inspect(scan, lidargrit.load_sensor(name).with_columns(columns))
        share = {fate: count / len(scan) for fate, count in found.counts().items()}
        said = f"{found.filled().mean():.0%} of the pixels filled; of the points {share['kept']:.0%} kept"
        said += f", {share['hidden']:.0%} hidden by nearer ones, {share['above'] + share['below']:.0%} beyond the rows"
        print(f"{way}: {said}")
        ahead = found.range_m[:, columns // 4 : columns * 3 // 4].astype(float)
        ahead[ahead == 0] = float("nan")
        axis.imshow(ahead, aspect="auto", cmap="turbo", norm=LogNorm(2, 80), interpolation="none")
        axis.set_title(f"{way}: {said}", fontsize=9)
        axis.set(xticks=[], yticks=[0, len(ahead) - 1], ylabel="row")
    figure.savefig(folder / "what_a_projection_loses.png", dpi=100, metadata={"Software": None})
    plt.close(figure)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "docs/pictures"))

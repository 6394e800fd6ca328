"""A scan from above, and the same scan as a range image with its return mask → scan_to_range_image.png."""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.colors import LogNorm

import lidargrit


def main(folder: Path) -> None:
    """Simulate, project, unproject and plot."""
    sensor = lidargrit.load_sensor("hdl64e_kitti_360")
    scan = lidargrit.simulate(seed=8, sensor=sensor)  # or lidargrit.load_scan("scan.bin")
    image = lidargrit.project(scan, sensor)
    again = lidargrit.unproject(image)  # one point for each return, on the ray of its pixel
    pixels, returns = image.return_mask.numel(), int(image.return_mask.sum())
    print(f"{len(scan):,} points, {returns:,} returns in {pixels:,} pixels, {len(again):,} points again")

    figure, axes = plt.subplot_mosaic("SRR;SMM", figsize=(11, 4), layout="constrained")
    look = {"cmap": "turbo", "norm": LogNorm(2, 80)}
    x, y, _ = scan.points_xyz_m.numpy().T
    axes["S"].scatter(-y, x, s=0.6, c=scan.points_xyz_m.norm(dim=1).numpy(), linewidths=0, **look)
    axes["S"].set(xlim=(-25, 25), ylim=(-30, 30), aspect="equal", title="a scan, from above", xlabel="metres")
    ranges = image.range_m.where(image.return_mask, float("nan")).numpy()
    plotted = axes["R"].imshow(ranges, aspect="auto", interpolation="none", **look)
    axes["R"].set(title="its range image: 64 rows, 1,024 columns", ylabel="row", xticks=[])
    figure.colorbar(plotted, ax=axes["R"], label="range [m]", ticks=[2, 5, 10, 20, 50], format="%d").minorticks_off()
    axes["M"].imshow(image.return_mask.numpy(), aspect="auto", cmap="gray", interpolation="none")
    axes["M"].set(title="its return mask: white where the ray came back", ylabel="row")
    axes["M"].set_xlabel("column; straight ahead is in the middle, the left is on the left")
    figure.savefig(folder / "scan_to_range_image.png", dpi=100, metadata={"Software": None})
    plt.close(figure)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "docs/pictures"))

"""Where rays would end, how likely each comes back, and which did: what the simulator knows → raydrop.png."""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm

from lidargrit.scans.sensors import load_sensor
from lidargrit.simulator import observe


def main(folder: Path) -> None:
    """Observe one street and plot its part straight ahead."""
    seen = observe(8, load_sensor("hdl64e_kitti_360"))
    clean = np.where(seen.clean_range_m > 0, seen.clean_range_m, np.nan)
    coin = np.random.default_rng(0).random(clean.shape) < seen.return_mask.mean()
    print(f"{seen.return_mask.mean():.1%} of the rays came back")
    metres, likely = {"cmap": "turbo", "norm": LogNorm(2, 80)}, {"cmap": "gray", "vmin": 0, "vmax": 1}
    chance = seen.return_probability
    panels = [
        ("clean range: what each ray meets (white: nothing)", clean, metres),
        ("probability that it comes back: dark on glass, far away, and on our own car", chance, likely),
        ("sampled from it: the range as measured", np.where(seen.return_mask, seen.range_m, np.nan), metres),
        ("as many rays dropped by a coin: no sensor looks like this", np.where(coin, clean, np.nan), metres),
    ]
    columns = clean.shape[1]
    figure, axes = plt.subplots(len(panels), figsize=(10, 6.4), layout="constrained")
    for axis, (title, values, look) in zip(axes, panels, strict=True):
        axis.imshow(values[:, columns // 4 : columns * 3 // 4], aspect="auto", interpolation="none", **look)
        axis.set_title(title, fontsize=10)
        axis.set(xticks=[], yticks=[0, 63], ylabel="row")
    figure.savefig(folder / "raydrop.png", dpi=100, metadata={"Software": None})
    plt.close(figure)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "docs/pictures"))

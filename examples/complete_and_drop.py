"""A blind sector filled in → completion.png. A clean scan before and after raydrop → raydrop_by_model.png."""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
from jaxtyping import Float
from matplotlib.colors import LogNorm
from torch import Tensor

import lidargrit
from lidargrit.core.errors import ConfigError, LidarGritError
from lidargrit.evaluation.realism import simulate_pair
from lidargrit.inference.complete.patterns import Pattern
from lidargrit.scans.condition import Observed
from lidargrit.scans.fills import fill
from lidargrit.scans.types import RangeImage
from lidargrit.systems.lidargrit.system import LidarGrit, TokenSampling

STREET = 10_000_012  # a seed that no packaged model has learned from
SAMPLES = 8  # as many as are computed at once


def main(folder: Path, run: str = "pretrained") -> None:
    """Complete a simulated scan four times, drop returns of its clean ranges, and plot both."""
    model = lidargrit.load(run)
    if not isinstance(model, LidarGrit):
        raise ConfigError(f"{run}, a model of {model.public_name()!r}", "one of LidarGRIT", "name another run")
    completes = lidargrit.load(run, "complete")
    clean, true = (RangeImage.stack([image]) for image in simulate_pair(STREET, model.sensor))
    known = Observed.of_pixels(true, Pattern("sector:45,315").mask(true[0])[None])
    panels = [("a simulated scan", true[0]), ("what is known of it", known.images[0])]
    panels.append(("filled in by triangulation", fill("triangulation", known)[0]))
    sampled = model.complete(Observed.cat([known] * SAMPLES), range(SAMPLES), TokenSampling())
    panels += [(f"sampled by the model, seed {seed}", sampled[seed]) for seed in range(4)]
    if isinstance(completes, LidarGrit):
        panels.append(("sampled by the model, seed 4", sampled[4]))
    else:
        panels.append(("the best guess of its network for completion", completes.complete(known, [0])[0]))
    plot(panels, folder / "completion.png")
    dropped = model.complete(Observed.cat([Observed.of_surfaces(clean)] * SAMPLES), range(SAMPLES))
    panels = [("clean ranges, as a simulator casts them", clean[0])]
    panels += [(f"after raydrop, seed {seed}", dropped[seed]) for seed in range(2)]
    panels.append(("as the simulator's own sensor drops", true[0]))
    share = dropped.return_mask.float().mean(0).where(clean.return_mask[0], float("nan"))
    plot(panels, folder / "raydrop_by_model.png", share)
    print(f"street {STREET} by {run}: {folder / 'completion.png'} and {folder / 'raydrop_by_model.png'}")


def plot(panels: list[tuple[str, RangeImage]], path: Path, share: Float[Tensor, "H W"] | None = None) -> None:
    """Plot range images below one another, and beneath them the share of returns."""
    count = len(panels) + (share is not None)
    figure, axes = plt.subplots(count, figsize=(8, 1.35 * count), layout="constrained")
    for axis, (title, image) in zip(axes, panels, strict=False):
        axis.set_facecolor("black")  # no return
        seen = image.range_m.where(image.return_mask, float("nan"))
        axis.imshow(seen.numpy(), aspect="auto", interpolation="none", cmap="turbo", norm=LogNorm(2, 80))
        axis.set_title(title, fontsize=10)
    if share is not None:
        axes[-1].imshow(share.numpy(), aspect="auto", interpolation="none", cmap="gray", vmin=0, vmax=1)
        axes[-1].set_title("share of the samples in which a ray returns (white: always)", fontsize=10)
    for axis in axes:
        axis.set(xticks=[], yticks=[])
    figure.savefig(path, dpi=100, metadata={"Software": None})
    plt.close(figure)


if __name__ == "__main__":
    try:
        main(Path("docs/pictures"), *sys.argv[1:2])
    except LidarGritError as error:
        raise SystemExit(str(error)) from None

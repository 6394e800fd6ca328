"""One scan after some phases of a pixel decoder, and the same tokens without it → pixel_phases.png."""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.colors import LogNorm

import lidargrit
from lidargrit.core.errors import ConfigError, LidarGritError
from lidargrit.generation.pixel_decoder.pixel_decoder import PixelDecoder
from lidargrit.generation.pixel_decoder.pixel_phases import completed_lattices
from lidargrit.systems.lidargrit.system import LidarGrit, TokenSampling

SEED = 3
SHOWN = 4  # finest lattices of sampled pixels


def main(folder: Path, run: str = "pretrained") -> None:
    """Sample one scan with and without the pixel decoder, and show it as it grows."""
    model = lidargrit.load(run)
    if not isinstance(model, LidarGrit) or not isinstance(model.pixels, PixelDecoder):
        raise ConfigError(
            f"{run}, which has no pixel decoder", "a run with one", "train the preset lidargrit_compact_pixels"
        )
    scan, plain = model.sample([SEED])[0], model.sample([SEED], sampling=TokenSampling(mask="bernoulli"))[0]
    phases = model.pixels.mask.phases
    panels = []
    for lattice, count in completed_lattices(phases)[-SHOWN:]:
        panels.append((f"after {count} of {len(phases)} phases", scan.range_m[lattice.pixels]))
    panels.append(("the same tokens without a pixel decoder", plain.range_m))
    figure, axes = plt.subplots(len(panels), figsize=(8, 7.5), layout="constrained")
    for axis, (title, range_m) in zip(axes, panels, strict=True):
        axis.set_facecolor("black")  # no return
        seen = range_m.where(range_m > 0, float("nan"))
        axis.imshow(seen.numpy(), aspect="auto", interpolation="none", cmap="turbo", norm=LogNorm(2, 80))
        axis.set_title(title, fontsize=10)
        axis.set(xticks=[], yticks=[])
    figure.savefig(folder / "pixel_phases.png", dpi=100, metadata={"Software": None})
    plt.close(figure)
    print(f"seed {SEED} of {run}: {len(phases)} phases in {folder / 'pixel_phases.png'}")


if __name__ == "__main__":
    try:
        main(Path("docs/pictures"), *sys.argv[1:2])
    except LidarGritError as error:
        raise SystemExit(str(error)) from None

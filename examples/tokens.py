"""A range image, its tokens, and what a small VQ-VAE makes of them that has learned it for seconds → tokens.png."""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from matplotlib.colors import LogNorm

import lidargrit
from lidargrit.generation.tokenizers.vqvae import Vqvae, VqvaeConfig
from lidargrit.scans.example import Example
from lidargrit.scans.types import RangeImage

STEPS = 60  # a taste, of one street; the preset `lidargrit_small` takes thousands, of thousands


def main(folder: Path) -> None:
    """Learn one street by heart, and show what its tokens hold."""
    sensor = lidargrit.load_sensor("hdl64e_kitti_odometry").with_columns(512, 4)  # 64x128, small for a quick look
    scan = lidargrit.simulate(8, sensor, kept_columns_only=True)
    street = RangeImage.stack([lidargrit.project(scan, sensor)])  # tokenizers work on batches

    rng = torch.Generator().manual_seed(0)
    torch.manual_seed(0)
    config = VqvaeConfig(
        channels=32,
        channel_multipliers=(1, 1, 1),
        code_dim=32,
        num_codes=256,
        dropout=0.0,
        padding="wrap",
        range_encoding="log",
        reconstruction="returns",
        codebook_loss="ema",
        raydrop_weight=1.0,  # of so few steps, more for the mask
    )
    tokenizer = Vqvae(config, sensor)
    optimiser = torch.optim.Adam(tokenizer.parameters(), 3e-3)
    for _ in range(STEPS):
        terms = tokenizer(Example(street), rng)
        optimiser.zero_grad()
        terms["loss"].backward()
        optimiser.step()
    tokenizer.eval()
    with torch.no_grad():
        tokens = tokenizer.encode(street)
        decoded = tokenizer.decode(tokens)
    shape = "x".join(map(str, tokens.tokens.shape[1:]))
    print(f"{shape} tokens of {tokens.num_codes}; range error in training {float(terms['range_mae_m']):.1f} m")

    metres, likely = {"cmap": "turbo", "norm": LogNorm(2, 80)}, {"cmap": "gray", "vmin": 0, "vmax": 1}
    clean, chance = decoded.range_m[0], decoded.return_logits[0].sigmoid()
    mask = chance >= 0.5
    seen = street.range_m[0].where(street.return_mask[0], float("nan"))
    panels = [
        ("a range image", seen, metres),
        (f"its tokens: {shape} numbers from 0 to {tokens.num_codes - 1}", tokens.tokens[0], {"cmap": "tab20"}),
        ("decoded: the clean range", clean, metres),
        ("decoded: the probability of a return", chance, likely),
        ("both together: range where a return is likelier than none", clean.where(mask, float("nan")), metres),
    ]
    figure, axes = plt.subplots(len(panels), figsize=(8, 7), layout="constrained")
    for axis, (title, values, look) in zip(axes, panels, strict=True):
        axis.imshow(values.numpy(), aspect="auto", interpolation="none", **look)
        axis.set_title(title, fontsize=10)
        axis.set(xticks=[], yticks=[])
    figure.savefig(folder / "tokens.png", dpi=100, metadata={"Software": None})
    plt.close(figure)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "docs/pictures"))

"""Attention to neighbours, three ways: as `lidargrit` does it, by Tensor.unfold, and over all tokens under a mask.

    OMP_NUM_THREADS=1 python benchmarks/attention_windows.py [--batch 4]

Each way computes R2Flow's attention to 3x9 tokens, forward and backward, in bfloat16, at the three levels of the preset
`r2flow_small` that have it and at the finest level of the published size. Rounds alternate between the ways, and the
best processor time of each counts. Prints seconds, their ratio to ours, and the largest difference of the results.
"""

import argparse
import time
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from lidargrit.systems.r2flow.hdit import neighbourhood_attention

ROUNDS = 5
LEVELS = {  # heads, rows, columns, channels of a head
    "small, finest": (1, 64, 64, 24),
    "small, second": (2, 32, 32, 24),
    "small, third": (4, 16, 16, 24),
    "published, finest": (2, 64, 256, 64),
}
MASKED_UP_TO = 4096  # tokens: the mask of more would not fit in memory


def unfolded(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """Return the attention of each group of eight columns to views of the padded keys and values."""

    def windows(x: Tensor) -> Tensor:
        x = torch.cat((x[:, :, :, -4:], x, x[:, :, :, :4]), dim=3).unfold(3, 16, 8).unfold(2, 3, 1)
        return torch.cat((x[:, :, :1], x, x[:, :, -1:]), dim=2).flatten(-2)

    offset = torch.arange(16) - torch.arange(8)[:, None]
    unseen = ((offset < 0) | (offset > 8)).repeat_interleave(3, dim=1)
    keys, values = windows(k), windows(v)
    weights = (q.unflatten(3, (-1, 8)) @ keys).float().masked_fill(unseen, -torch.inf).softmax(-1)
    return (weights.type_as(values) @ values.transpose(-1, -2)).flatten(3, 4)


def masked(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    """Return torch's attention over all tokens, those outside the window masked."""
    rows, columns = q.shape[2:4]
    row, column = torch.arange(rows), torch.arange(columns)
    near_rows = (row.clamp(1, rows - 2)[:, None] - row).abs() <= 1
    apart = (column[:, None] - column) % columns
    near_columns = (apart <= 4) | (apart >= columns - 4)
    seen = (near_rows[:, None, :, None] & near_columns[None, :, None]).reshape(rows * columns, -1)
    mixed = F.scaled_dot_product_attention(*(each.flatten(2, 3) for each in (q, k, v)), attn_mask=seen, scale=1.0)
    return mixed.unflatten(2, (rows, columns))


def step(attention: Callable[[Tensor, Tensor, Tensor], Tensor], inputs: Tensor) -> tuple[float, Tensor]:
    """Return the processor time of one pass forward and backward in seconds, and what it computed."""
    inputs = inputs.detach().requires_grad_()
    begun = time.process_time()
    out = attention(*inputs)
    out.backward(torch.ones_like(out))
    return time.process_time() - begun, out.detach().float()


def main() -> None:
    """Print a table of the three ways."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, default=4, help="number of scans")
    batch = parser.parse_args().batch
    print("| level | ours | Tensor.unfold | all tokens under a mask | largest difference |\n|---|---|---|---|---|")
    for name, (heads, rows, columns, channels) in LEVELS.items():
        inputs = torch.randn(3, batch, heads, rows, columns, channels, generator=torch.Generator().manual_seed(0))
        inputs = inputs.bfloat16()
        ways = [neighbourhood_attention, unfolded, masked][: 3 if rows * columns <= MASKED_UP_TO else 2]
        rounds = [[step(way, inputs) for way in ways] for _ in range(ROUNDS)]
        best = [min(seconds for seconds, _ in each) for each in zip(*rounds, strict=True)]
        cells = [f"{seconds:.4f} s ({seconds / best[0]:.1f})" for seconds in best] + ["too large"] * (3 - len(ways))
        apart = max(float((out - rounds[0][0][1]).abs().max()) for _, out in rounds[0])
        print(f"| {name} | {' | '.join(cells)} | {apart:.3f} |", flush=True)


if __name__ == "__main__":
    main()

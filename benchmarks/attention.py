"""Attention of the transformers over tokens, two ways: as `lidargrit` does it on a CPU in bfloat16, and torch's kernel.

    OMP_NUM_THREADS=1 python benchmarks/attention.py [--batch 8]

Each way computes the attention of one block, forward and backward, at the sizes of several presets. Rounds alternate
between the ways, and the best processor time of each counts. Prints seconds, their ratio to ours, and for each way the
difference of its result from that of 32 bits, as a share of the norm.
"""

import argparse
import time
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from lidargrit.nn.transformer import attend

ROUNDS = 8
SIZES = {  # heads, tokens, channels of a head, causal
    "lidargrit_compact_pixels": (4, 256, 64, True),
    "small": (4, 1024, 48, True),
    "published": (8, 1024, 32, True),
    "maskgit_small": (4, 1024, 48, False),
    "a masked transformer of 256 tokens": (4, 256, 64, False),
}


def fused(query: Tensor, key: Tensor, value: Tensor, *, causal: bool) -> Tensor:
    """Return torch's attention."""
    return F.scaled_dot_product_attention(query, key, value, is_causal=causal)


def step(attention: Callable[..., Tensor], inputs: Tensor, causal: bool) -> tuple[float, Tensor]:
    """Return the processor time of one pass forward and backward in seconds, and what it computed."""
    inputs = inputs.detach().requires_grad_()
    begun = time.process_time()
    out = attention(*inputs, causal=causal)
    out.backward(torch.ones_like(out))
    return time.process_time() - begun, out.detach().float()


def main() -> None:
    """Print a table of both ways."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, default=8, help="number of scans")
    batch = parser.parse_args().batch
    print("| preset | ours | torch's kernel | difference from 32 bits, ours | the kernel's |\n|---|---|---|---|---|")
    for name, (heads, tokens, channels, causal) in SIZES.items():
        inputs = torch.randn(3, batch, heads, tokens, channels, generator=torch.Generator().manual_seed(0)).bfloat16()
        rounds = [[step(way, inputs, causal) for way in (attend, fused)] for _ in range(ROUNDS)]
        ours, kernel = (min(seconds for seconds, _ in each) for each in zip(*rounds, strict=True))
        exact = fused(*inputs.float(), causal=causal)
        apart = [float((out - exact).norm() / exact.norm()) for _, out in rounds[0]]
        times = f"{ours * 1e3:.1f} ms | {kernel * 1e3:.1f} ms ({kernel / ours:.1f} times)"
        print(f"| {name} | {times} | {apart[0]:.4f} | {apart[1]:.4f} |", flush=True)


if __name__ == "__main__":
    main()

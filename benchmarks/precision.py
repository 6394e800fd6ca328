"""What 16 and 8 bits cost in quality: bits per token, and metres and flipped returns of decoded scans.

    python benchmarks/precision.py RUN [--scans simulated:32:val]

RUN is a trained LidarGRIT. Bits per token are the mean over the scans' own tokens, which each precision reads one by
one as it would generate them; beside them how far its odds lie from those in 32 bits (KL divergence, bits per token).
Decoding is of the same tokens; a return is flipped where P(return) crosses a half, and a sampled one where the uniform
number of its pixel falls between the two probabilities. Ranges are compared where both have a return.
"""

import argparse
from functools import partial
from pathlib import Path

import torch
import torch.nn.functional as F

from lidargrit.generators import load
from lidargrit.generators.lidargrit import LidarGrit, TokenSampling, after_start, sample_token
from lidargrit.loading import DataConfig
from lidargrit.nn.decoding import CachedDecoder
from lidargrit.sources import load_range_images
from lidargrit.structures import TokenGrid


def stepwise_logits(generator: LidarGrit, tokens: torch.Tensor, precision: str) -> torch.Tensor:
    """Return the logits (B, T, K) that the decoder computes when it is given the tokens one by one."""
    by_choices = partial(sample_token, sampling=TokenSampling())
    decoder = CachedDecoder(generator.transformer, len(tokens), by_choices, precision=precision)
    inputs = after_start(tokens[:, :-1])
    return torch.stack([decoder.next_logits(inputs[:, at], at) for at in range(inputs.shape[1])], dim=1)


def compare_odds(generator: LidarGrit, tokens: torch.Tensor) -> None:
    """Print bits per token by each precision."""
    exact = generator.transformer(after_start(tokens[:, :-1])).double().log_softmax(-1)
    for precision in ("fp32", "bf16", "int8"):
        odds = stepwise_logits(generator, tokens, precision).double().log_softmax(-1)
        nats = F.nll_loss(odds.movedim(-1, 1), tokens)
        exact_nats = F.nll_loss(exact.movedim(-1, 1), tokens)
        divergence = (exact.exp() * (exact - odds)).sum(-1).mean()
        bits = torch.stack((nats, nats - exact_nats, divergence)) / torch.log(torch.tensor(2.0, dtype=torch.double))
        print(
            "weights {:<6}{:9.4f} bits a token, {:+.5f} to the whole pass; KL {:.6f}".format(precision, *bits.tolist())
        )


def compare_decoding(generator: LidarGrit, grid: TokenGrid) -> None:
    """Print how far decoded ranges and returns move by each precision."""
    plain = generator.tokenizer.decode(grid)
    uniform = torch.rand(plain.range_m.shape, generator=torch.Generator().manual_seed(0))
    for precision in ("fp32", "bf16"):
        quick = generator.tokenizer.for_decoding(precision).decode(grid)
        both = (plain.return_logits >= 0) & (quick.return_logits >= 0)
        error_m = (plain.range_m - quick.range_m).abs()[both]
        flipped = ((plain.return_logits >= 0) != (quick.return_logits >= 0)).float().mean()
        sampled = (
            ((uniform < plain.return_logits.sigmoid()) != (uniform < quick.return_logits.sigmoid())).float().mean()
        )
        print(
            f"decoder {precision:<6}mean {error_m.mean():.5f} m, median {error_m.median():.5f} m, "
            f"99 % below {error_m[:: max(1, len(error_m) // 10**6)].quantile(0.99):.4f} m, most {error_m.max():.3f} m; "
            f"returns flipped by threshold {100 * flipped:.4f} %, as sampled {100 * sampled:.4f} %"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run_folder", type=Path)
    parser.add_argument("--scans", default="simulated:32:val", help="a source of scans that were not trained on")
    options = parser.parse_args()
    torch.set_grad_enabled(False)
    generator = load(options.run_folder)
    assert isinstance(generator, LidarGrit)
    images = load_range_images([options.scans], DataConfig(), sensor=generator.sensor)
    batches = [images.batch(list(range(first, min(first + 8, len(images))))) for first in range(0, len(images), 8)]
    tokens = torch.cat([generator.tokenizer.encode(batch).tokens for batch in batches])
    print(f"{options.run_folder.name}, {len(tokens)} scans of {options.scans}")
    compare_odds(generator, tokens.flatten(1))
    compare_decoding(generator, TokenGrid(tokens, generator.tokenizer.num_codes))


if __name__ == "__main__":
    main()

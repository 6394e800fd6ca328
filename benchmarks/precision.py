"""What 16 and 8 bits cost in quality: bits per token, and metres and flipped returns of decoded scans.

    python benchmarks/precision.py RUN [--scans simulated:32:val]

RUN is a trained LidarGRIT. Bits per token are the mean over the scans' own tokens, which each precision reads one by
one as it would generate them; beside them how far its odds lie from those in 32 bits (KL divergence, bits per token).
Decoding is of the same tokens; a return is flipped where P(return) crosses a half, and a sampled one where the uniform
number of its pixel falls between the two probabilities. Ranges are compared where both have a return.
A pixel decoder, if there is one, samples around the same tokens with the same random numbers by each precision; one
pixel that comes out otherwise moves later ones, so the bits of both sets of scans and the neighbours that differ by
more than 2 m are beside them.
"""

import argparse
import math
import time
from functools import partial
from pathlib import Path

import torch
import torch.nn.functional as F

from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources import load_range_images
from lidargrit.generation.generator import load
from lidargrit.generation.pixel_decoder.pixel_decoder import PixelSampling, nats_to_range_bits
from lidargrit.nn.decoding import CachedDecoder
from lidargrit.scans.types import TokenGrid
from lidargrit.systems.lidargrit.system import LidarGrit, TokenSampling, after_start, sample_token


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


def compare_pixels(generator: LidarGrit, grid: TokenGrid) -> None:
    """Print how the pixel decoder's scans differ by each precision, and the processor time of one."""
    assert generator.pixels is not None
    scans, first = {}, TokenGrid(grid.tokens[:1], grid.num_codes)
    for precision in ("fp32", "bf16"):
        tokenizer, sampling = generator.tokenizer.for_decoding(precision), PixelSampling(precision=precision)
        rngs = [torch.Generator().manual_seed(seed) for seed in range(grid.tokens.shape[0])]
        generator.pixels.sample(tokenizer.decode(first), rngs[:1], sampling)  # it chooses kernels
        rngs[0].manual_seed(0)
        begun = time.process_time()
        scans[precision] = generator.pixels.sample(tokenizer.decode(grid), rngs, sampling)
        seconds = (time.process_time() - begun) / len(rngs)
        mask, range_m = scans[precision].return_mask, scans[precision].range_m
        both = mask & mask.roll(1, -1)
        far = ((range_m - range_m.roll(1, -1)).abs() > 2)[both].float().mean()
        nll = generator.pixels(generator.tokenizer.decode(grid), scans[precision])
        bits = nll.mask.mean() / math.log(2), nats_to_range_bits(nll.range[mask]).mean()
        print(
            f"pixels {precision:<6}{seconds:.3f} s a scan; {100 * mask.float().mean():.3f} % returns, "
            f"neighbours > 2 m apart {100 * far:.2f} %; bits of the mask a pixel {bits[0]:.4f}, "
            f"of ranges a return {bits[1]:.3f}"
        )
    exact, quick = scans["fp32"], scans["bf16"]
    both, flipped = exact.return_mask & quick.return_mask, exact.return_mask != quick.return_mask
    error_m = (exact.range_m - quick.range_m).abs()[both]
    print(
        f"pixels, one against the other: returns flipped {100 * flipped.float().mean():.3f} %; ranges median "
        f"{error_m.median():.4f} m apart, more than 0.5 m in {100 * (error_m > 0.5).float().mean():.2f} %"
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
    grid = TokenGrid(tokens, generator.tokenizer.num_codes)
    compare_decoding(generator, grid)
    if generator.pixels is not None:
        compare_pixels(generator, grid)


if __name__ == "__main__":
    main()

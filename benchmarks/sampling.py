"""Seconds to generate tokens, to decode them, and for whole scans: ours and recomputation, side by side in one run.

    python benchmarks/sampling.py [--preset lidargrit_kitti_360] [--batch 1 16] [--roofline]

Random weights from a seed: the time does not depend on them. Recomputation reads the whole prefix again for every token
as the released program does, but leaner: it takes the logits of the last position only. A whole scan of it would take
minutes, so single steps are timed at the middle of four equal spans of the length, and summed. All of ours runs in
full. Times are the best of the repeats, for other work on the machine only ever adds to them; with OMP_NUM_THREADS=1
they are the processor's, which do not count waiting for neighbours. The limit of a step is
the longer of its bytes at the rate at which this machine reads memory and its operations at the rate of its products,
both measured in the same run.
"""

import argparse
import time
from functools import partial
from statistics import mean

import torch

from lidargrit.generation.presets import load_preset
from lidargrit.nn.decoding import CachedDecoder, flops_of_step
from lidargrit.nn.flops import flops_of
from lidargrit.nn.transformer import CausalTransformer
from lidargrit.systems.lidargrit.system import LidarGrit, TokenSampling, sample_token

PRECISIONS = ("fp32", "bf16", "int8")
SPANS = 4


def seconds(work, repeats: int = 1) -> float:
    """Return the least of several times."""
    clock, times = time.process_time if torch.get_num_threads() == 1 else time.perf_counter, []
    for _ in range(repeats):
        begun = clock()
        work()
        times.append(clock() - begun)
    return min(times)


def read_rate(megabytes: int) -> float:
    """Return how many bytes a second the machine reads of so much memory, over and over."""
    memory = torch.ones(megabytes * 2**18)
    return memory.nbytes / seconds(memory.sum, 10)


def product_rate(dtype: torch.dtype, rows: int = 2048) -> float:
    """Return how many operations a second the machine does in a product of matrices."""
    one, other = torch.ones(rows, 1024, dtype=dtype), torch.ones(1024, 1024, dtype=dtype)
    return 2 * rows * 1024**2 / seconds(lambda: one @ other, 10)


def convolution_rate(dtype: torch.dtype) -> float:
    """Return how many operations a second the machine does in a 3x3 convolution of the decoder's largest size."""
    x = torch.ones(1, 128, 64, 1024, dtype=dtype).to(memory_format=torch.channels_last)
    weight = torch.ones(128, 128, 3, 3, dtype=dtype).to(memory_format=torch.channels_last)
    return 2 * 9 * 128**2 * 64 * 1024 / seconds(lambda: torch.conv2d(x, weight, padding=1), 5)


def last_logits(transformer: CausalTransformer, tokens: torch.Tensor) -> torch.Tensor:
    """Return the logits after a whole prefix, as lean as recomputation can be."""
    x = transformer.tok_emb(tokens) + transformer.pos_emb[:, : tokens.shape[1]]
    for block in transformer.blocks:
        x = block(x)
    return transformer.head(transformer.ln_f(x[:, -1]))


def recomputing(transformer: CausalTransformer, batch: int, repeats: int) -> float:
    """Return the seconds that all tokens take by recomputation, from a step in the middle of each span."""
    length, step = transformer.context_length, transformer.context_length // SPANS
    prefixes = [torch.zeros((batch, n), dtype=torch.long) for n in range(step // 2, length, step)]
    return sum(seconds(partial(last_logits, transformer, prefix), repeats) for prefix in prefixes) * step


def step_bytes(transformer: CausalTransformer, batch: int, precision: str) -> float:
    """Return the bytes that a step reads, in the mean over all: weights once, keys and values of half the length."""
    sizes = transformer.config
    blocks, head = 12 * sizes.layers * sizes.width**2, sum(each.numel() for each in transformer.head.parameters())
    cached = 2 * sizes.layers * sizes.width * (transformer.context_length + 1) / 2 * batch
    number = 4 if precision == "fp32" else 2
    return blocks * (1 if precision == "int8" else number) + (head + cached) * number


def step_flops(transformer: CausalTransformer, batch: int) -> float:
    """Return the operations of a step, in the mean over all."""
    return batch * mean(flops_of_step(transformer, position) for position in range(transformer.context_length))


def compare_tokens(transformer: CausalTransformer, batch: int, rates: dict[str, float], beside: bool = True) -> float:
    """Print a line for each precision, beside recomputation or alone; return the seconds of recomputation."""
    uniform = torch.rand((batch, transformer.context_length), generator=torch.Generator().manual_seed(0))
    repeats = 3 if batch == 1 else 1
    recomputed = recomputing(transformer, batch, repeats) if beside else float("nan")
    for precision in PRECISIONS:
        decoder = CachedDecoder(
            transformer, batch, partial(sample_token, sampling=TokenSampling()), precision=precision
        )
        taken = seconds(partial(decoder.generate, uniform), repeats)
        flop_rate = rates["product fp32" if precision == "fp32" else "product bf16"]
        bytes_, flops = step_bytes(transformer, batch, precision), step_flops(transformer, batch)
        reading = bytes_ / rates["40 MB" if batch == 1 else "400 MB"]
        limit = transformer.context_length * max(reading, flops / flop_rate)
        print(
            f"tokens, batch {batch:<4}{precision:<6}{taken:9.2f} s  recomputed{recomputed:9.1f} s"
            f"{recomputed / taken:8.1f} times {bytes_ / 1e6:7.1f} MB{flops / 1e9:7.2f} GFLOP a step"
            f"  limit{limit:7.2f} s, share {limit / taken:.2f}",
            flush=True,
        )
        if beside:  # again, so that both meet the same neighbours
            recomputed = min(recomputed, recomputing(transformer, batch, 1))
    return recomputed


def compare_decoding(generator: LidarGrit, rates: dict[str, float]) -> float:
    """Print how long one scan's decoding takes, plain and prepared; return the plain seconds."""
    height, width = generator.tokenizer.grid_size
    latents = torch.randn(1, generator.config.tokenizer.code_dim, height, width)
    versions = {"plain fp32": generator.tokenizer.decoder}
    versions |= {f"ours {p}": generator.tokenizer.decoder.prepared(p) for p in ("fp32", "bf16")}
    best = dict.fromkeys(versions, float("inf"))
    for _ in range(4):
        for name, decoder in versions.items():
            best[name] = min(best[name], seconds(partial(decoder, latents)))
    for name, decoder in versions.items():
        flops = flops_of(decoder, tuple(latents.shape))
        limit = flops / rates["convolution bf16" if "bf16" in name else "convolution fp32"]
        print(
            f"decoding, {name:<11}{best[name]:9.3f} s{best['plain fp32'] / best[name]:8.2f} times"
            f"{flops / 1e9:8.1f} GFLOP{flops / 1e9 / best[name]:8.0f} GFLOP/s  limit{limit:7.3f} s,"
            f" share {limit / best[name]:.2f}",
            flush=True,
        )
    return best["plain fp32"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="lidargrit_kitti_360")
    parser.add_argument("--batch", type=int, nargs="*", default=[1, 16])
    parser.add_argument("--roofline", action="store_true", help="also how time grows with batch, length and width")
    options = parser.parse_args()
    torch.manual_seed(0)
    torch.set_grad_enabled(False)
    preset = load_preset(options.preset)
    generator = LidarGrit(preset.model, preset.data.load_sensor()).eval()
    transformer = generator.transformer
    rates = {f"{megabytes} MB": read_rate(megabytes) for megabytes in (40, 400)}
    kinds = (("fp32", torch.float32), ("bf16", torch.bfloat16))
    rates |= {f"product {name}": product_rate(dtype) for name, dtype in kinds}
    rates |= {f"convolution {name}": convolution_rate(dtype) for name, dtype in kinds}
    print(f"{options.preset}, torch {torch.__version__}, {torch.get_num_threads()} threads, a second:")
    print(", ".join(f"{name} {rate / 1e9:.1f} G" for name, rate in rates.items()), flush=True)
    plain_decoding = compare_decoding(generator, rates)
    for batch in options.batch:
        recomputed = compare_tokens(transformer, batch, rates)
        plain = recomputed + batch * plain_decoding
        for weights, decoder in (("fp32", "fp32"), ("int8" if batch == 1 else "bf16", "bf16")):
            sampling = TokenSampling(guidance=1.0, weights=weights, decoder=decoder)
            whole = seconds(partial(generator.sample, range(batch), sampling=sampling))
            print(
                f"whole scans, batch {batch:<4}weights {weights}, decoder {decoder}{whole:9.2f} s  plain{plain:9.1f} s"
                f"{plain / whole:8.1f} times{60 * batch / whole:8.1f} scans a minute",
                flush=True,
            )
    if options.roofline:
        from dataclasses import replace  # noqa: PLC0415

        for batch, length, width in ((1, 256, 256), (16, 256, 256), (256, 256, 256), (1, 256, 512), (1, 512, 256)):
            other = CausalTransformer(replace(transformer.config, width=width), 1024, (1, length)).eval()
            print(f"length {length}, width {width}:")
            compare_tokens(other, batch, rates, beside=False)


if __name__ == "__main__":
    main()

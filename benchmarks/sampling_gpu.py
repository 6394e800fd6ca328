"""Scans a second on a GPU: ours, recomputation, and R2DM's 256 steps, side by side in one run.

    python benchmarks/sampling_gpu.py [--batch 1 64 512] [--weights bf16] [--compile]

Random weights: the time does not depend on them. Ours runs in full: tokens by CUDA graphs, decoding in 16 bits, masks
sampled. Recomputation reads the whole prefix again for every token, in 16 bits too, and takes the logits of the last
position only; its steps are timed in the middle of four equal spans of the length and summed. Of R2DM one step is timed
and taken as often as is published. Batches too large for the memory are left out. On a CPU (``--device cpu --preset
lidargrit_small --r2dm r2dm_small --batch 1``) it shows that the script runs, and nothing else.
"""

import argparse
import time
from functools import partial

import torch

from lidargrit.generation.generator import load_class
from lidargrit.generation.presets import load_preset
from lidargrit.nn.transformer import CausalTransformer
from lidargrit.systems.lidargrit.system import LidarGrit, TokenSampling
from lidargrit.systems.r2dm.system import DiffusionSampling, R2dm

SPANS = 4


def seconds(work, device: torch.device, repeats: int = 3) -> float:
    """Return the least of several times, the first run left out, with everything on the device done."""
    times = []
    for _ in range(repeats + 1):
        begun = time.perf_counter()
        work()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        times.append(time.perf_counter() - begun)
    return min(times[1:])


def last_logits(transformer: CausalTransformer, tokens: torch.Tensor) -> torch.Tensor:
    """Return the logits after a whole prefix, as lean as recomputation can be."""
    with torch.autocast(tokens.device.type, torch.bfloat16):
        x = transformer.tok_emb(tokens) + transformer.pos_emb[:, : tokens.shape[1]]
        for block in transformer.blocks:
            x = block(x)
        return transformer.head(transformer.ln_f(x[:, -1]))


def recomputing(transformer: CausalTransformer, batch: int, device: torch.device) -> float:
    """Return the seconds that all tokens of a batch take by recomputation."""
    length, step = transformer.context_length, transformer.context_length // SPANS
    prefixes = [torch.zeros((batch, n), dtype=torch.long, device=device) for n in range(step // 2, length, step)]
    return sum(seconds(partial(last_logits, transformer, prefix), device) for prefix in prefixes) * step


def denoising(model: R2dm, batch: int, device: torch.device) -> float:
    """Return the seconds that R2DM takes for a batch, in 16 bits."""
    noisy, log_snr = torch.randn(batch, *model.shape, device=device), torch.zeros(batch, device=device)

    def step() -> None:
        with torch.autocast(device.type, torch.bfloat16):
            model.network(noisy, log_snr)

    return seconds(step, device) * DiffusionSampling().steps


def ours(
    generator: LidarGrit, batch: int, sampling: TokenSampling, compiled: bool, device: torch.device
) -> list[float]:
    """Return the seconds of the tokens of a batch, and of whole scans."""
    decoder, tokenizer = generator._prepare(batch, sampling)
    if compiled:
        tokenizer.decoder.compile()
    uniform = torch.rand(batch, generator.transformer.context_length, device=device)
    tokens = seconds(partial(decoder.generate, uniform), device)
    return [tokens, seconds(partial(generator.sample, range(batch), sampling=sampling), device)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="lidargrit_kitti_360")
    parser.add_argument("--r2dm", default="r2dm_kitti_360", help="a preset of R2DM")
    parser.add_argument("--batch", type=int, nargs="+", default=[1, 64, 512])
    parser.add_argument("--weights", choices=["fp32", "bf16"], default="bf16")
    parser.add_argument("--compile", action="store_true", help="also compile the decoder")
    parser.add_argument("--device", default="cuda")
    options = parser.parse_args()
    torch.set_grad_enabled(False)
    torch.manual_seed(0)
    device = torch.device(options.device)
    preset, other = load_preset(options.preset), load_preset(options.r2dm)
    generator = LidarGrit(preset.model, preset.data.load_sensor()).eval().to(device)
    rival = load_class("r2dm")(other.model, other.data.load_sensor()).eval().to(device)
    sampling = TokenSampling(guidance=1.0, weights=options.weights, decoder="bf16")
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "a CPU, for a smoke run"
    print(f"{name}, torch {torch.__version__}, weights {options.weights}; scans a second")
    print("batch      ours  tokens only  recomputed      R2DM  ours/recomputed  ours/R2DM")
    for batch in options.batch:
        works = (
            partial(ours, generator, batch, sampling, options.compile, device),
            partial(recomputing, generator.transformer, batch, device),
            partial(denoising, rival, batch, device),
        )
        taken: list[float] = []
        for work in works:
            try:
                found = work()
            except torch.cuda.OutOfMemoryError:
                found = [float("inf")] * 2 if work is works[0] else float("inf")
                torch.cuda.empty_cache()
            taken += found if isinstance(found, list) else [found]
        tokens, whole, recomputed, rival_s = taken
        decoding = whole - tokens
        print(
            f"{batch:>5}{batch / whole:>10.2f}{batch / tokens:>13.2f}{batch / (recomputed + decoding):>12.3f}"
            f"{batch / rival_s:>10.3f}{(recomputed + decoding) / whole:>17.1f}{rival_s / whole:>11.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()

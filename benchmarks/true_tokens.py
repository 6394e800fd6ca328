"""Scans → what a generator of tokens draws from their own tokens: its samples, if its transformer made no error.

    python benchmarks/true_tokens.py RUN SCANS drawn -n 128 [--set range_temperature=0.2 ...]
    lidargrit evaluate drawn SCANS --sensor drawn/sensor.json --protocol objects -n 128

Of labelled scans it prints how many poles and trunks still stand, and how much of vehicles' windows is open.
What these draws lack, the first stage has lost; what the samples of the run lack besides, the transformer has.
OUT is new: it gets a range image in metres (``.npy``, 0 where no return) for each scan, and their sensor.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import torch
from relay.upright_objects import kept_objects
from relay.windows import kept_windows

from lidargrit.core import reporting
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources import open_source
from lidargrit.generation.generator import load
from lidargrit.generation.tokens import DecodingOfTokens, TokenGenerator
from lidargrit.scans.types import RangeImage

_LEAST_OF_POLES = 3  # pixels for 64 columns


def main() -> None:
    """Encode and draw scan by scan."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", help="run of a system that samples tokens, such as lidargrit")
    parser.add_argument("scans", help="source of scans, as for evaluate")
    parser.add_argument("out", type=Path, help="folder to write")
    parser.add_argument("--set", nargs="+", default=[], metavar="NAME=VALUE", help="settings of sampling")
    parser.add_argument("-n", type=int, default=128, metavar="SCANS")
    options = parser.parse_args()
    generator = load(options.run)
    assert isinstance(generator, TokenGenerator), "a run that samples no tokens"
    sampling = generator.parse_sampling(options.set)
    images = open_source(options.scans).images(generator.sensor, DataConfig(max_scans=options.n))
    options.out.mkdir(parents=True)
    (options.out / "sensor.json").write_text(json.dumps(generator.sensor.to_json()))
    drawn, truth = [], []
    with reporting.progress("drawing", len(images)) as progress:
        for index in range(len(images)):
            truth.append(images.batch([index]))
            drawn.append(draw(generator, truth[-1], sampling, seed=index))
            range_m = torch.where(drawn[-1].return_mask, drawn[-1].range_m, 0.0)[0]
            np.save(options.out / f"{index:06d}.npy", range_m.numpy())
            progress.advance(1)
    if truth[0].label is not None:
        before, after = (RangeImage.cat(images) for images in (truth, drawn))
        print("poles and trunks:", kept_objects(before, after, _LEAST_OF_POLES * generator.sensor.width // 64))
        print("windows of vehicles:", kept_windows(before, after))


@torch.no_grad()
def draw(generator: TokenGenerator, images: RangeImage, sampling: DecodingOfTokens, seed: int) -> RangeImage:
    """Return a scan that the generator decodes from the tokens of another one."""
    tokens = generator.tokenizer.encode(images).tokens.flatten(1)
    rngs = [torch.Generator().manual_seed(seed)]
    return generator.decode(tokens, 1, rngs, sampling.mask, sampling.pixels(), generator.tokenizer)


if __name__ == "__main__":
    main()

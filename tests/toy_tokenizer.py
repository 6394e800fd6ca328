"""A second tokenizer, as small as one can be: the mean range of each block of pixels, rounded to one of some levels.

It is no file of the package; ``installed`` puts it among the tokenizers for as long as a test lasts. Beside a range it
decodes reflectance and features, and its ranges have noise, which shows that a decoder may.
"""

import importlib.util
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lidargrit.core import discovery
from lidargrit.generation.tokenizers import Tokenizer, TokenizerConfig
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import Decoded, MaskDecoding, RangeImage, TokenGrid

NAME = "toy_tokenizer"


@dataclass(frozen=True)
class ToyConfig(TokenizerConfig):
    """Sizes.

    Args:
        block: rows and columns of pixels behind one token.
        levels: number of different tokens.
        noise_m: metres, standard deviation of sampled ranges.
    """

    block: int = 8
    levels: int = 16
    noise_m: float = 0.1


class ToyTokenizer(Tokenizer[ToyConfig]):
    """Blocks of pixels, each by the nearest of learned ranges."""

    num_features = 2

    def __init__(self, config: ToyConfig, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        self.num_codes = config.levels
        self.grid_size = (sensor.height // config.block, sensor.width // config.block)
        limits = math.log(sensor.range_min_m), math.log(sensor.range_max_m)
        self.log_ranges = nn.Parameter(torch.linspace(*limits, config.levels))
        self.logits = nn.Parameter(torch.zeros(config.levels))

    def encode(self, images: RangeImage) -> TokenGrid:
        """Return the level nearest to the mean range of each block's returns."""
        range_m = F.avg_pool2d(images.range_m, self.config.block)
        share = F.avg_pool2d(images.return_mask.float(), self.config.block)
        log_range = (range_m / share.clamp(min=1e-6)).clamp(self.sensor.range_min_m).log()
        return TokenGrid((log_range[..., None] - self.log_ranges).abs().argmin(-1), self.num_codes)

    def decode(self, tokens: TokenGrid) -> Decoded:
        """Return the same of all pixels of a block."""
        block = self.config.block
        pixels = tokens.tokens.repeat_interleave(block, -2).repeat_interleave(block, -1)
        limits = self.sensor.range_min_m, self.sensor.range_max_m
        range_m = self.log_ranges[pixels].exp().clamp(*limits)
        reflectance = pixels / self.num_codes
        features = torch.stack((range_m, reflectance), dim=1)
        return Decoded(range_m, self.logits[pixels], self.sensor, reflectance, features)

    def sample(
        self, tokens: TokenGrid, rngs: Sequence[torch.Generator], mask: MaskDecoding = "bernoulli"
    ) -> RangeImage:
        """Return scans whose returns and ranges are both random."""
        images = super().sample(tokens, rngs, mask)
        noise = torch.stack([torch.randn(images.range_m.shape[1:], generator=rng) for rng in rngs])
        range_m = (images.range_m + self.config.noise_m * noise).clamp(self.sensor.range_min_m, self.sensor.range_max_m)
        return RangeImage.masked(range_m, images.return_mask, self.sensor, images.planes)

    def decoding_flops(self) -> int:
        """Return 0: nothing is multiplied."""
        return 0

    def forward(self, example: Example, rng: torch.Generator, player: str = "") -> dict[str, Tensor]:
        """Return the error of the ranges' logarithms and the cross-entropy of returns."""
        images = example.images
        decoded, mask = self.decode(self.encode(images)), images.return_mask
        error = (decoded.range_m.log() - images.range_m.clamp(self.sensor.range_min_m).log()).abs()[mask].mean()
        raydrop = F.binary_cross_entropy_with_logits(decoded.return_logits, mask.float())
        return {"loss": error + raydrop, "raydrop": raydrop}

    def warnings(self) -> list[str]:
        """Return a line, so that a test can look for it."""
        return ["this tokenizer is a toy"]


def installed(monkeypatch) -> type[TokenizerConfig]:
    """Make this file a tokenizer of the package, as if it lay in its folder, and return its configuration."""
    name = f"lidargrit.generation.tokenizers.{NAME}"
    spec = importlib.util.spec_from_file_location(name, Path(__file__))
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)
    known, toy = discovery._places, {NAME: discovery._Place(Path(__file__), name)}
    monkeypatch.setattr(discovery, "_places", lambda kind: known(kind) | (toy if kind == "tokenizers" else {}))
    return module.ToyConfig

"""What generators of tokens have in common, whatever their tokenizer and in whatever order they sample its tokens."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from lidargrit.generators import Generator
from lidargrit.nn.objective import Objective
from lidargrit.nn.processes import sum_over_processes
from lidargrit.nn.transformer import Transformer, TransformerConfig
from lidargrit.sensors import SensorModel
from lidargrit.structures import MaskDecoding, RangeImage, TokenGrid
from lidargrit.tokenizers import Tokenizer, TokenizerConfig, make_tokenizer
from lidargrit.tokenizers.vqvae import VqvaeConfig

_DECODED_AT_ONCE = 4  # scans; enough to keep a GPU busy, and more would only take memory: 35 MB a layer at 64x1024


@dataclass(frozen=True)
class TokenGeneratorConfig:
    """The two networks of a generator of tokens.

    Args:
        tokenizer: configuration of any tokenizer.
        transformer: sizes of the transformer over its tokens.
    """

    tokenizer: TokenizerConfig = field(default_factory=VqvaeConfig)
    transformer: TransformerConfig = field(default_factory=TransformerConfig)


TokenConfigT = TypeVar("TokenConfigT", bound=TokenGeneratorConfig)
SamplingT = TypeVar("SamplingT")


class TokenGenerator(Generator[TokenConfigT, SamplingT]):
    """A tokenizer, trained first, and a ``transformer`` over its tokens, trained over the frozen tokenizer."""

    Config = TokenGeneratorConfig
    capabilities = frozenset({"tokens", "encode"})

    def __init__(self, config: TokenConfigT, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        self.tokenizer = make_tokenizer(config.tokenizer, sensor)

    @classmethod
    def smallest_config(cls, sensor: SensorModel) -> TokenConfigT:
        """Return a VQ-VAE of one block a level, and a transformer of one layer."""
        tokenizer = VqvaeConfig(channels=32, channel_multipliers=(1, 1, 1, 1), code_dim=8, num_codes=32)
        return cls.Config(tokenizer, TransformerConfig(layers=1, heads=2, width=16))

    @property
    def stages(self) -> tuple[str, ...]:
        """The tokenizer, then the transformer over its tokens."""
        return ("tokenizer", "transformer")

    def load_stage(self, stage: str, objective: Objective) -> None:
        """Take over a stage's trained weights."""
        if stage == "tokenizer":
            self.tokenizer.load_state_dict(objective.state_dict())
        else:
            trained = objective.get_submodule("transformer")
            self.get_submodule("transformer").load_state_dict(trained.state_dict())

    def get_tokenizer(self) -> Tokenizer:
        """Return the tokenizer."""
        return self.tokenizer

    def _reconstruct(self, images: RangeImage) -> RangeImage:
        """Return what the tokens keep of a batch of scans, the mask by threshold."""
        return self.tokenizer.reconstruct(images)

    def decode(
        self, tokens: Int[Tensor, "B T"], rngs: list[torch.Generator], mask: MaskDecoding, tokenizer: Tokenizer
    ) -> RangeImage:
        """Return the scans of sampled tokens.

        They are decoded in batches of one size, as tokens are sampled, because kernels differ by the size. Copies that
        fill up the end of a batch are not decoded again, beyond what that size needs.

        Args:
            tokens: tokens of ``compute_batch`` scans in raster order.
            rngs: random generators on the CPU, one for each scan.
            mask: how returns are decided.
            tokenizer: the generator's own, or what that gives for decoding only.
        """
        wanted, seeds = len(rngs), [rng.initial_seed() for rng in rngs]
        while wanted > 1 and seeds[wanted - 1] == seeds[wanted - 2]:
            wanted -= 1
        images = []
        for first in range(0, wanted, _DECODED_AT_ONCE):
            some = slice(first, first + _DECODED_AT_ONCE)
            grid = TokenGrid(tokens[some].unflatten(1, tokenizer.grid_size), tokenizer.num_codes)
            images.append(tokenizer.sample(grid, rngs[some], mask))
        return RangeImage.cat(images)[[*range(wanted), *[wanted - 1] * (len(rngs) - wanted)]]


class TokenObjective(Objective):
    """Base of the objectives of transformers over the tokens of a frozen tokenizer."""

    token_counts: Tensor

    def __init__(self, tokenizer: Tokenizer, transformer: Transformer) -> None:
        super().__init__(tokenizer.sensor)
        self.transformer = transformer
        self._frozen = [tokenizer.eval().requires_grad_(False)]  # in a list: its weights are not this stage's
        self.register_buffer("token_counts", torch.ones(transformer.num_tokens))

    @torch.no_grad()
    def encode(self, images: RangeImage) -> tuple[Int[Tensor, "B T"], Float[Tensor, "B T"]]:
        """Return the tokens, and their negative log-likelihood in nats by a model that knows only token frequencies."""
        # Tokens are computed in full precision, as when a scan is encoded outside of training.
        with torch.autocast(images.range_m.device.type, enabled=False):
            self._frozen[0].to(images.range_m.device)
            tokens = self._frozen[0].encode(images).tokens.flatten(1)
        if self.training:
            counted = torch.bincount(tokens.flatten(), minlength=len(self.token_counts))
            self.token_counts += sum_over_processes(counted)
        return tokens, -(self.token_counts / self.token_counts.sum()).log()[tokens]


def sample_tokens(logits: Float[Tensor, "*B K"], uniform: Float[Tensor, "*B"]) -> Int[Tensor, "*B"]:
    """Sample one token for each row of logits: where the distribution function first exceeds its uniform number."""
    distribution = logits.double().softmax(dim=-1).cumsum(dim=-1)
    threshold = uniform.double()[..., None] * distribution[..., -1:]  # the sum may miss 1 by a rounding error
    return torch.searchsorted(distribution, threshold, right=True)[..., 0].clamp(max=logits.shape[-1] - 1)

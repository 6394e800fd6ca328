"""MaskGIT over LidarGRIT's tokens: a transformer generates many of them at once, in few passes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
import torch.nn.functional as F
from jaxtyping import Int
from torch import Tensor

from lidargrit.core.typed_values import Bounds, Temperature, Weight
from lidargrit.core.untrusted import STEPS_AT_MOST
from lidargrit.generation.batches import BatchSeeds
from lidargrit.generation.facts import Cost, SystemFacts
from lidargrit.generation.objective import Objective
from lidargrit.generation.tokens import DecodingOfTokens, TokenGenerator, TokenGeneratorConfig, TokenObjective
from lidargrit.nn.precision import Precision, autocast_to
from lidargrit.nn.random import gumbel_of, rngs_of, sample_index
from lidargrit.nn.transformer import MaskedTransformer
from lidargrit.scans.condition import Condition
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage

_NOT_ASKED = -100  # in the place of tokens that are shown, for torch's cross entropy


@dataclass(frozen=True)
class MaskedSampling(DecodingOfTokens):
    """Settings of sampling tokens, returns and ranges.

    Args:
        steps: number of passes of the transformer; at most one for each token.
        temperature: divisor of the logits: above 1 scans vary more than the model's own, below 1 less; 0 takes the
            likeliest token.
        order_temperature: scale of the Gumbel noise in the choice of the tokens that a pass keeps. It is added to the
            logarithm of a token's probability and falls to 0 with the last pass; 0 keeps the likeliest tokens, and the
            larger it is, the more random the order. The default is that of the authors' program.
        weights: number type of the transformer's products. ``fp32`` is exact; ``bf16`` computes them in 16 bits, as
            training does where that is quicker; ``auto`` is ``bf16`` where the machine has instructions for it;
            ``tf32`` rounds what a GPU multiplies to 11 digits.
    """

    steps: Annotated[int, Bounds(1, STEPS_AT_MOST)] = 16
    temperature: Temperature = 1.0
    order_temperature: Weight = 4.5
    weights: Precision = "fp32"


@dataclass(frozen=True)
class MaskGitConfig(TokenGeneratorConfig):
    """The tokenizer of LidarGRIT, and a transformer of the same blocks that sees all tokens."""


class MaskGit(TokenGenerator[MaskGitConfig, MaskedSampling]):
    """Parallel generation of tokens: fewer passes than tokens, at some cost in quality.

    A pass samples every hidden token given those that are shown, and shows some of them. Tokens of one pass are sampled
    independently of one another, so the scans are not those of an exact model.

    Source:
        Chang et al., MaskGIT: Masked Generative Image Transformer, CVPR 2022, section 3; order temperature as in
        google-research/maskgit.
    """

    Config = MaskGitConfig
    facts = SystemFacts(
        generates="range and raydrop, decoded apart from each other; reflectance if model.tokenizer.reflectance is set",
        paper="Chang et al., MaskGIT: Masked Generative Image Transformer, CVPR 2022, over LidarGRIT's tokens",
        program="google-research/maskgit (Apache 2.0)",
    )
    Sampling = MaskedSampling

    def __init__(self, config: MaskGitConfig, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        height, width = self.tokenizer.grid_size
        self.transformer = MaskedTransformer(config.transformer, self.tokenizer.num_codes, height * width)

    def transformer_objective(self) -> Objective:
        """Return the likelihood of hidden tokens given those shown."""
        return HiddenTokens(self.tokenizer, self.transformer)

    @classmethod
    def quickest_sampling(cls) -> MaskedSampling:
        """Return 4 passes."""
        return MaskedSampling(steps=4)

    def _sample(self, seeds: BatchSeeds, condition: Condition, sampling: MaskedSampling) -> RangeImage:
        self.check_choice(sampling.mask, sampling.pixels())
        rngs = rngs_of(seeds)
        tokens = generate_tokens(self.transformer, rngs, sampling)
        tokenizer = self.tokenizer.for_decoding(sampling.decoder)
        return self.decode(tokens, seeds.num_asked_for, rngs, sampling.mask, sampling.pixels(), tokenizer)

    def cost(self, sampling: MaskedSampling | None = None) -> Cost:
        """Return the cost of the passes over all tokens and of one decoding."""
        sampling = sampling or MaskedSampling()
        sizes, tokens = self.config.transformer, self.transformer.context_length
        # Per token and layer: four projections and a perceptron of four times the width, then queries by keys and
        # weights by values over all tokens.
        layer = 24 * sizes.width**2 + 4 * sizes.width * tokens
        one_pass = tokens * (sizes.layers * layer + self.transformer.head.flops)
        passes = len(numbers_hidden(tokens, sampling.steps))
        decoding = self.decoding_cost(sampling.mask)
        return Cost(passes + decoding.network_evaluations, passes * one_pass + decoding.flops)


class HiddenTokens(TokenObjective):
    """The transformer's objective: negative log-likelihood of hidden tokens given those shown, in nats per token."""

    transformer: MaskedTransformer

    def forward(self, example: Example, rng: torch.Generator, player: str = "") -> dict[str, Tensor]:
        """Return the paper's eq. 1 per hidden token, and the same of a model that knows only token frequencies."""
        tokens, unigram_nll = self.encode(example)
        count, length = tokens.shape
        # Each scan's progress is uniform in [0, 1); within a batch they are evenly spread, which calms the loss.
        apart = torch.arange(count, device=rng.device) / count
        progress = (torch.rand(1, generator=rng, device=rng.device) + apart) % 1
        hidden_each = (share_hidden(progress) * length).ceil().clamp(min=1)
        rank = torch.rand(tokens.shape, generator=rng, device=rng.device).argsort(dim=1).argsort(dim=1)
        hidden = (rank < hidden_each[:, None]).to(tokens.device)
        logits = self.transformer(tokens.masked_fill(hidden, self.transformer.mask_token))
        # Shown tokens are left out by a word for them, not by an index, whose shape would depend on values.
        wanted = tokens.masked_fill(~hidden, _NOT_ASKED)
        loss = F.cross_entropy(logits.float().flatten(0, 1), wanted.flatten(), ignore_index=_NOT_ASKED)
        return {"loss": loss, "unigram_nll": (unigram_nll * hidden).sum() / hidden.sum()}


def share_hidden(progress: Tensor) -> Tensor:
    """Return the share of tokens that is hidden: 1 at a progress of 0, 0 at a progress of 1.

    Source:
        Chang et al., MaskGIT, 2022, section 3.3: the cosine schedule.
    """
    return (progress * (math.pi / 2)).cos()


def numbers_hidden(num_tokens: int, steps: int) -> list[int]:
    """Return the number of tokens still hidden after each pass, by the cosine schedule.

    Every pass shows at least one token; with as many steps as tokens, each shows one.
    """
    passes, left = min(steps, num_tokens), num_tokens
    found = []
    for done in range(1, passes):
        left = min(math.ceil(num_tokens * math.cos(math.pi / 2 * done / passes)), left - 1)
        found.append(left)
    return [*found, 0]


def generate_tokens(
    transformer: MaskedTransformer, rngs: Sequence[torch.Generator], sampling: MaskedSampling
) -> Int[Tensor, "B T"]:
    """Generate one sequence for each random generator; all tokens are hidden at first, fewer after each pass."""
    device, length = transformer.pos_emb.device, transformer.context_length
    tokens = torch.full((len(rngs), length), transformer.mask_token, device=device)
    schedule = numbers_hidden(length, sampling.steps)
    for done, left in enumerate(schedule, start=1):
        uniform = torch.stack([torch.rand(2, length, generator=rng) for rng in rngs], dim=1).to(device)
        with autocast_to(sampling.weights, device):
            logits = transformer(tokens).float()
        cold = sampling.temperature == 0
        sampled = logits.argmax(dim=-1) if cold else sample_index(logits / sampling.temperature, uniform[0])
        confidence = logits.log_softmax(dim=-1).gather(-1, sampled[..., None])[..., 0]
        confidence += sampling.order_temperature * (1 - done / len(schedule)) * gumbel_of(uniform[1])
        hidden = tokens == transformer.mask_token
        kept = confidence.masked_fill(~hidden, torch.inf).topk(length - left, dim=1).indices
        tokens = tokens.scatter(1, kept, torch.where(hidden, sampled, tokens).gather(1, kept))
    return tokens

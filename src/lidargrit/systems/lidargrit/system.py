"""LidarGRIT: a transformer generates the tokens of a VQ-VAE one by one, and its decoder makes range images of them."""

import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from lidargrit.core.typed_values import Bounds, NotNegative, Temperature
from lidargrit.generation.batches import BatchSeeds
from lidargrit.generation.facts import Cost, SystemFacts
from lidargrit.generation.objective import Objective
from lidargrit.generation.tokenizers import Tokenizer
from lidargrit.generation.tokens import DecodingOfTokens, TokenGenerator, TokenGeneratorConfig, TokenObjective
from lidargrit.nn.decoding import CachedDecoder, WeightPrecision, flops_of_step
from lidargrit.nn.published import read_checkpoint
from lidargrit.nn.random import of_host, rngs_of, sample_index
from lidargrit.nn.transformer import CausalTransformer
from lidargrit.scans.condition import Condition, ConditionKind, Observed
from lidargrit.scans.example import Example
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage, TokenGrid

START_TOKEN = 0  # the reference prepends an ordinary token, shared with the first code, not one of its own
_PUBLISHED_BYTES_AT_MOST = 2 << 30  # the first release's transformer of 126 M weights, with its optimiser, takes 1.6 GB
_PUBLISHED_NETWORKS = {  # by our name: the program's name, and entries of its checkpoint that are no weights
    "tokenizer": ("VQ", ("loss.*",)),  # a discriminator and an image network, whose terms have the weight 0
    "transformer": ("Transformer", ("*.attn.mask",)),  # a triangle of ones
}
_GUIDANCE_AT_MOST = 100  # far beyond what is of use, and safe in 32 bits


@dataclass(frozen=True)
class TokenSampling(DecodingOfTokens):
    """Settings of sampling tokens, returns and ranges.

    Args:
        temperature: divisor of the logits: above 1 scans vary more than the model's own, below 1 less; 0 takes the
            likeliest token.
        top_k: number of the likeliest tokens that are sampled from. 0 takes all, since the paper names no number. The
            released program takes 100, which makes the scans of a barely trained model bland.
        top_p: total probability of the likeliest tokens that are sampled from; 1 for all.
        guidance: weight w of logits weaker + w (own - weaker), by which tokens are sampled. The weaker logits are those
            of the same transformer without the attention of its last block but one, or of its only one. Above 1, scans
            and regions differ more from one another; 1 leaves the transformer's own distribution; 0 takes the model's
            setting (``model.guidance``).
        weights: number type of the transformer's weights. ``fp32`` is exact; ``bf16`` and ``int8`` (CPUs only) read
            less memory for a token and change probabilities a little, see docs/performance.md.
    """

    temperature: Temperature = 1.0
    top_k: NotNegative = 0
    top_p: Annotated[float, Bounds(above=0, most=1)] = 1.0
    guidance: Annotated[float, Bounds(1, _GUIDANCE_AT_MOST, or_0=True)] = 0.0
    weights: WeightPrecision = "fp32"


@dataclass(frozen=True)
class LidarGritConfig(TokenGeneratorConfig):
    """Configuration of the tokenizer, the transformer, and what the paper does not have.

    Args:
        guidance: value of :attr:`TokenSampling.guidance` where the caller names none; 1 in the paper. What suits a
            model is found on validation scans.
    """

    guidance: Annotated[float, Bounds(1, _GUIDANCE_AT_MOST)] = 1.0


class LidarGrit(TokenGenerator[LidarGritConfig, TokenSampling]):
    """The paper's system.

    Source:
        Haghighi et al., Taming Transformers for Realistic Lidar Point Cloud Generation, 2024.
    """

    Config = LidarGritConfig
    facts = SystemFacts(
        generates="range and raydrop, decoded apart from each other; reflectance if model.tokenizer.reflectance is set "
        "(filled in where scans are completed)",
        paper="Haghighi et al., Taming Transformers for Realistic Lidar Point Cloud Generation, 2024",
        program="hamedhaghighi/LidarGRIT@a3f86e7 (no licence)",
        weights_licence="no licence stated",
    )
    Sampling = TokenSampling
    own_batches = (8, 32)  # a step for several scans takes little longer than for one
    published_files = tuple(_PUBLISHED_NETWORKS)
    capabilities = TokenGenerator.capabilities | {"complete"}

    def __init__(self, config: LidarGritConfig, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        features = self.tokenizer.code_features() if config.transformer.code_features else None
        sizes = self.tokenizer.num_codes, self.tokenizer.grid_size
        self.transformer = CausalTransformer(config.transformer, *sizes, features)
        self._decoder_cache: _DecoderCache | None = None
        self._one_at_a_time = threading.Lock()

    def transformer_objective(self) -> Objective:
        """Return the likelihood of each token given those before it."""
        return NextToken(self.tokenizer, self.transformer)

    def _sample(self, seeds: BatchSeeds, condition: Condition, sampling: TokenSampling) -> RangeImage:
        return self._by_tokens(None, seeds, sampling)

    @property
    def conditions(self) -> frozenset[ConditionKind]:
        """Observed pixels, and ranges of surfaces whose returns are sampled."""
        return frozenset({"pixels", "surfaces"})

    def _complete(self, condition: Observed, seeds: BatchSeeds, sampling: TokenSampling) -> RangeImage:
        return self._by_tokens(condition, seeds, sampling)

    def _by_tokens(self, condition: Observed | None, seeds: BatchSeeds, sampling: TokenSampling) -> RangeImage:
        """Generate the tokens without any observed pixel, and with a pixel decoder the pixels around observed ones.

        Tokens come row by row, or in windows column by column, and pixels in phases. Each is conditioned on the
        observed ones before it, not on later ones.
        """
        self.check_choice(sampling.mask, sampling.pixels())
        rngs = rngs_of(seeds)
        uniform = torch.stack([torch.rand(math.prod(self.tokenizer.grid_size), generator=rng) for rng in rngs])
        tokens = None if condition is None else self.observed_tokens(condition)
        with self._one_at_a_time:  # threads would write into one cache
            decoder, tokenizer = self._prepare(len(rngs), sampling)
            if tokens is None or bool((tokens < 0).any()):
                tokens = decoder.generate(uniform.to(self.device), tokens)
        return self.decode(tokens, seeds.num_asked_for, rngs, sampling.mask, sampling.pixels(), tokenizer, condition)

    def token_bits(self, grid: TokenGrid) -> Float[Tensor, "B h w"]:
        """Return the bits of each token given those before it."""
        return (nats_of_tokens(self.transformer, grid.tokens) / math.log(2)).float()

    def cost(self, sampling: TokenSampling | None = None) -> Cost:
        """Return the cost of one step of the transformer for each token, with a cache, and of one decoding."""
        sampling = sampling or TokenSampling()
        guidance, windows = self._guidance(sampling), self.transformer.windows
        sequences = 1 if windows is None else len(windows.in_turn())  # those of windows are read from their beginning
        of_one = sum(flops_of_step(self.transformer, at, guidance) for at in range(self.transformer.context_length))
        decoding = self.decoding_cost(sampling.mask)
        evaluations = math.prod(self.tokenizer.grid_size) + sequences - 1 + decoding.network_evaluations
        return Cost(evaluations, sequences * of_one + decoding.flops)

    def _guidance(self, sampling: TokenSampling) -> float:
        return sampling.guidance or self.config.guidance

    @torch.inference_mode(False)  # what is kept may be used outside of it, too
    @torch.no_grad()
    def _prepare(self, batch_size: int, sampling: TokenSampling) -> tuple[CachedDecoder, Tokenizer]:
        """Return what generates tokens and what decodes them, kept from the last call if nothing has changed since."""
        weights = self.state_dict()
        places = tuple((each.data_ptr(), each.device) for each in weights.values())
        guidance = self._guidance(sampling)
        choices = (sampling.temperature, sampling.top_k, sampling.top_p, guidance, sampling.weights, sampling.decoder)
        key = (batch_size, choices, places)
        if self._decoder_cache is None or not self._decoder_cache.serves(key, weights):
            self._decoder_cache = None  # its cache is given back before the next is taken
            by_choices = partial(sample_token, sampling=sampling)
            decoder = CachedDecoder(
                self.transformer, batch_size, by_choices, START_TOKEN, sampling.weights, guidance=guidance
            )
            copies = {name: each.clone() for name, each in weights.items()}
            self._decoder_cache = _DecoderCache(key, copies, decoder, self.tokenizer.for_decoding(sampling.decoder))
        return self._decoder_cache.decoder, self._decoder_cache.tokenizer

    def __getstate__(self) -> dict[str, object]:
        """Leave out what can be made again: functions and locks cannot be pickled."""
        return {
            name: value for name, value in self.__dict__.items() if name not in ("_decoder_cache", "_one_at_a_time")
        }

    def __setstate__(self, state: dict[str, object]) -> None:
        """Make again what was left out."""
        super().__setstate__(state)
        self._decoder_cache, self._one_at_a_time = None, threading.Lock()

    @classmethod
    def read_published(
        cls, files: Sequence[Path], config: LidarGritConfig, sensor: SensorModel
    ) -> tuple[LidarGritConfig, dict[str, dict[str, Tensor]]]:
        """Read the checkpoints of a VQ-VAE and a transformer, in which weights have the names of ours.

        The files tell neither the number of attention heads nor the order of tokens: only the order of the paper, row
        by row over the whole image, is known here.

        Source:
            hamedhaghighi/LidarGRIT@a3f86e7, models/base_model.py.
        """
        networks = {
            part: read_checkpoint(path, (name,), _PUBLISHED_BYTES_AT_MOST, ignored)
            for (part, (name, ignored)), path in zip(_PUBLISHED_NETWORKS.items(), files, strict=True)
        }
        return config, networks


class _DecoderCache(NamedTuple):
    key: object
    weights: Mapping[str, Tensor]
    decoder: CachedDecoder
    tokenizer: Tokenizer

    def serves(self, key: object, weights: Mapping[str, Tensor]) -> bool:
        """Return whether it was made of these very weights: neither their addresses nor torch's versions tell that."""
        if self.key != key:
            return False
        changed = [(each != self.weights[name]).any() for name, each in weights.items()]
        return not bool(torch.stack(changed).any())  # the host waits once for a GPU


class NextToken(TokenObjective):
    """The transformer's objective: negative log-likelihood of each token after those before it, in nats per token."""

    transformer: CausalTransformer

    def forward(self, example: Example, rng: torch.Generator, player: str = "") -> dict[str, Tensor]:
        """Return eq. 6 of the paper per token, beside it that of a model which knows only how often tokens occur.

        In training over windows, it is that of a few windows of each scan.
        """
        tokens, unigram_nll = self.encode(example)
        grid, windows = tokens.unflatten(1, self.grid_size), self.transformer.windows
        if self.training and windows is not None:
            grid = grid.repeat_interleave(self.transformer.config.windows_per_scan, 0)
            columns, counts = windows.draw(len(grid), of_host(rng))
            counts = counts.to(tokens.device).repeat_interleave(windows.grid_size[0], 1)
            loss = (_nats(self.transformer, windows.take(grid, columns), columns) * counts).sum() / counts.sum()
        else:
            loss = nats_of_tokens(self.transformer, grid).mean()
        return {"loss": loss, "unigram_nll": unigram_nll.mean()}


def nats_of_tokens(transformer: CausalTransformer, grid: Int[Tensor, "B h w"]) -> Float[Tensor, "B h w"]:
    """Return the nats of each token given those before it."""
    if transformer.windows is None:
        return _nats(transformer, grid.flatten(1)).view(grid.shape)
    found = grid.new_zeros(grid.shape, dtype=torch.float32)
    for columns, known in transformer.windows.in_turn():
        nats = _nats(transformer, transformer.windows.take(grid, columns), columns)
        found[:, :, columns[known:]] = nats.unflatten(1, (len(columns), -1)).transpose(1, 2)[:, :, known:]
    return found


def _nats(
    transformer: CausalTransformer, tokens: Int[Tensor, "B T"], columns: Int[Tensor, "*B W"] | None = None
) -> Float[Tensor, "B T"]:
    return transformer(after_start(tokens[:, :-1]), columns, tokens)


def after_start(tokens: Int[Tensor, "B T"]) -> Int[Tensor, "B T+1"]:
    """Prepend the start token."""
    return F.pad(tokens, (1, 0), value=START_TOKEN)


def sample_token(
    logits: Float[Tensor, "B K"], uniform: Float[Tensor, "B"], sampling: TokenSampling
) -> Int[Tensor, "B"]:
    """Sample one token for each row of logits, by its uniform number in [0, 1)."""
    if sampling.temperature == 0:
        return logits.argmax(dim=1)
    logits = logits.double() / sampling.temperature
    if 0 < sampling.top_k < logits.shape[1]:
        weakest = logits.topk(sampling.top_k, dim=1).values[:, -1:]
        logits = logits.masked_fill(logits < weakest, -torch.inf)  # ties with the weakest are kept, as in the program
    if sampling.top_p < 1:
        ordered, order = logits.softmax(dim=1).sort(dim=1, descending=True)
        spare = ordered.cumsum(dim=1) - ordered >= sampling.top_p  # the likelier ones hold enough
        logits = logits.masked_fill(torch.zeros_like(spare).scatter(1, order, spare), -torch.inf)
    return sample_index(logits, uniform)

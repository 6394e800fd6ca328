"""The second stage of UltraLiDAR: a transformer that fills in hidden tokens of a scan seen from above.

Source:
    Xiong et al., UltraLiDAR, CVPR 2023, section 3.3, after Chang et al., MaskGIT, CVPR 2022; numbers and layers as in
    myc634/UltraLiDAR_nusc_waymo@eb65fe0 (MIT).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from lidargrit.core.typed_values import Bounds, NotNegative, ShareBelow1, Weight
from lidargrit.generation.facts import SamplingSettings
from lidargrit.nn.blocks import Network
from lidargrit.systems.ultralidar.swin import SwinConfig, initialise_linear, sine_cosine_positions, swin_blocks

_SHOWN_LOG_P = math.log(1e10)  # the program's certainty of tokens that are shown already
_FORBIDDEN = -10_000.0  # logit of a code that may not be sampled
_SMOOTHING = 0.1  # of the labels
_STEPS_AT_MOST = 1000


@dataclass(frozen=True)
class FillSampling(SamplingSettings):
    """Settings of filling hidden tokens in.

    Args:
        steps: number of passes of the transformer; 30 are published.
        order_temperature: scale of the Gumbel noise in the choice of the tokens that a pass shows. It is added to the
            logarithm of a token's probability and falls to 0 with the last pass.
        blank_share: share of all codes that stand for empty space. They are those that the first pass finds likeliest,
            over all tokens; 20 of 1,024 codes are published.
        blank_steps: number of passes, from the first, in which none of these codes may be sampled. Without this, most
            scans come out empty: empty space is the surest token, and sure tokens are shown first.
    """

    steps: Annotated[int, Bounds(1, _STEPS_AT_MOST)] = 30
    order_temperature: Weight = 2.0
    blank_share: ShareBelow1 = 20 / 1024
    blank_steps: NotNegative = 10


class VoxelPrior(Network):
    """Codes of a scan, of which some are hidden → logits of every token.

    Args:
        config: sizes; 24 blocks are published.
        tokens: number of tokens along y and along x.
    """

    pos_embed: Tensor

    def __init__(self, config: SwinConfig, tokens: tuple[int, int], num_codes: int, code_dim: int) -> None:
        super().__init__()
        self.mask_token = nn.Parameter(torch.empty(1, 1, code_dim))
        self.decoder_embed = nn.Linear(code_dim, config.width)
        self.blocks = swin_blocks(config, tokens)
        self.register_buffer("pos_embed", sine_cosine_positions(tokens, config.width), persistent=False)
        self.norm = nn.Sequential(nn.LayerNorm(config.width), nn.GELU())
        self.pred = nn.Linear(config.width, num_codes)
        self.apply(initialise_linear)
        nn.init.normal_(self.mask_token, std=0.02)

    def forward(self, seen: Float[Tensor, "B T D"]) -> Float[Tensor, "B T K"]:
        """Return the logits of every token, given what :meth:`hide` leaves to be seen."""
        return self.pred(self.norm(self.blocks(self.decoder_embed(seen) + self.pos_embed)))

    def hide(self, codes: Float[Tensor, "B T D"], hidden: Bool[Tensor, "B T"]) -> Float[Tensor, "B T D"]:
        """Return the codes with the learned one in place of those that are hidden."""
        return torch.where(hidden[..., None], self.mask_token, codes)


def hidden_at_random(noise: Float[Tensor, "B T"], share: float | Float[Tensor, ""]) -> Bool[Tensor, "B T"]:
    """Return which tokens are hidden: a share of those of each scan, rounded up, where the noise is largest."""
    shown = torch.as_tensor(noise.shape[1] * (1 - share), dtype=torch.float64).long().clamp(max=noise.shape[1] - 1)
    return noise.argsort(dim=1).argsort(dim=1) >= shown


def hidden_token_loss(
    logits: Float[Tensor, "B T K"], tokens: Int[Tensor, "B T"], hidden: Bool[Tensor, "B T"]
) -> Float[Tensor, ""]:
    """Return the cross-entropy of the hidden tokens, in nats a token, with smoothed labels."""
    nats = F.cross_entropy(logits.float().transpose(1, 2), tokens, label_smoothing=_SMOOTHING, reduction="none")
    return (nats * hidden).sum() / hidden.sum()


def number_hidden(length: int, progress: float) -> int:
    """Return how many of ``length`` tokens are hidden after a share ``progress`` of all passes: at least 1 of several.

    Source:
        Chang et al., MaskGIT, 2022, section 3.3: the cosine schedule.
    """
    return int(min(max(1.0, length * math.cos(math.pi / 2 * progress)), length - 1))


def likeliest_codes(logits: Float[Tensor, "B T K"], share: float) -> Int[Tensor, "B blank"]:
    """Return the codes that are likeliest over all tokens of a scan.

    The program counts samples of a hundred batches; this is what such counts tend to.
    """
    return logits.softmax(dim=-1).mean(dim=1).topk(round(share * logits.shape[-1])).indices


def forbid(logits: Float[Tensor, "B T K"], codes: Int[Tensor, "B blank"]) -> Float[Tensor, "B T K"]:
    """Return logits by which none of these codes is sampled."""
    return logits.scatter(-1, codes[:, None].expand(-1, logits.shape[1], -1), _FORBIDDEN)


def hide_unsure(
    sampled_log_p: Float[Tensor, "B T"],
    hidden: Bool[Tensor, "B T"],
    gumbel: Float[Tensor, "B T"],
    progress: float,
    order_temperature: float,
) -> Bool[Tensor, "B T"]:
    """Return which tokens are hidden again after a pass: those whose log-probability and noise sum up to least.

    Args:
        sampled_log_p: logarithm of the probability with which each token was sampled.
        hidden: mask of the tokens that were hidden before the pass.
        gumbel: noise of Gumbel's distribution.
        progress: share of all passes that is done, this one included.
        order_temperature: scale of the noise at the first pass.
    """
    noise = order_temperature * (1 - progress) * gumbel
    confidence = torch.where(hidden, sampled_log_p, _SHOWN_LOG_P) + noise
    border = confidence.sort(dim=1).values[:, number_hidden(hidden.shape[1], progress)]
    return confidence < border[:, None]


def generate_tokens(
    logits_of: Callable[[Int[Tensor, "B T"], Bool[Tensor, "B T"]], Float[Tensor, "B T K"]],
    start: Int[Tensor, "B T"],
    fill: Callable[[Float[Tensor, "B T K"]], Int[Tensor, "B T"]],
    gumbel: Callable[[], Float[Tensor, "B T"]],
    sampling: FillSampling,
    blank: Int[Tensor, "B blank"] | None = None,
) -> Int[Tensor, "B T"]:
    """Sample all tokens of new scans, in passes that show more and more of them.

    Args:
        logits_of: the transformer: tokens, and which of them are hidden → logits.
        start: tokens of any value, all of which are hidden at first.
        fill: sampler of tokens: logits of every token → a token each.
        gumbel: source of noise of Gumbel's distribution.
        sampling: number of passes, and how they are made.
        blank: codes that stand for empty space; by default the likeliest of the first pass.
    """
    tokens, hidden = start, torch.ones_like(start, dtype=torch.bool)
    for done in range(1, sampling.steps + 1):
        logits = logits_of(tokens, hidden)
        if blank is None:
            blank = likeliest_codes(logits, sampling.blank_share)
        if done <= sampling.blank_steps:
            logits = forbid(logits, blank)
        tokens = torch.where(hidden, fill(logits), tokens)
        if done < sampling.steps:
            log_p = logits.log_softmax(dim=-1).gather(-1, tokens[..., None])[..., 0]
            hidden = hide_unsure(log_p, hidden, gumbel(), done / sampling.steps, sampling.order_temperature)
    return tokens

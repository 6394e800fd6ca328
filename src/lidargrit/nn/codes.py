"""Logits and embeddings of codes, by weights of each code or by weights that codes share by what they stand for."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from lidargrit.core.errors import ConfigError

_FEATURES_LENGTH = 3.0  # of each code's: what codes share then moves more quickly than what each has of its own


class CodeFeatures(NamedTuple):
    """What codes stand for.

    Args:
        of_codes: features of every code; codes that stand for like things have like features.
        group_size: number of codes of a group, such as those of one range. Code 0 is alone, groups follow one another.
    """

    of_codes: Float[Tensor, "K F"]
    group_size: int


class CodeHead(nn.Linear):
    """The logits of all codes, each the product with a vector of its own, without bias."""

    def __init__(self, width: int, num_codes: int) -> None:
        super().__init__(width, num_codes, bias=False)

    def nats(self, x: Float[Tensor, "B T C"], codes: Int[Tensor, "B T"]) -> Float[Tensor, "B T"]:
        """Return the negative log-likelihood of one code at each position."""
        return _nats(self(x), codes)

    @property
    def flops(self) -> int:
        """Floating-point operations of the logits of all codes at one position."""
        return 2 * self.in_features * self.out_features


class GroupedCodeHead(nn.Module):
    """The group of the next code, and given that which code of the group it is.

    The likelihood of one code takes the logits of all groups and of one group's codes. With 128 groups of 65 codes that
    is an eighteenth of the operations of a logit for each code, and a rare code is learned from those like it.

    Args:
        width: length of the vector that stands for a position.
        num_codes: number of codes: code 0, and those of all groups.
        group_size: number of codes of a group.
    """

    def __init__(self, width: int, num_codes: int, group_size: int) -> None:
        super().__init__()
        if (num_codes - 1) % group_size:
            got = f"{num_codes} codes in groups of {group_size}"
            raise ConfigError(got, "code 0 and whole groups", "choose another size of the groups")
        self.group_size, self.width = group_size, width
        self.num_groups = (num_codes - 1) // group_size
        self.group = nn.Linear(width, 1 + self.num_groups, bias=False)
        self.hidden = nn.Linear(width, width)
        self.of_group = nn.Embedding(self.num_groups, width)
        self.in_group = nn.Linear(width, group_size)

    def forward(self, x: Float[Tensor, "*B C"]) -> Float[Tensor, "*B K"]:
        """Return the log-probabilities of all codes, as the sum of that of the group and that within the group."""
        alone, groups = self.group(x).float().log_softmax(-1).split((1, self.num_groups), -1)
        hidden = F.gelu(self.hidden(x).unsqueeze(-2) + self.of_group.weight)
        within = self.in_group(hidden).float().log_softmax(-1)
        return torch.cat((alone, (groups.unsqueeze(-1) + within).flatten(-2)), -1)

    def nats(self, x: Float[Tensor, "B T C"], codes: Int[Tensor, "B T"]) -> Float[Tensor, "B T"]:
        """Return the negative log-likelihood of one code at each position."""
        of_groups = (codes - 1).clamp(min=0)
        group, code = of_groups // self.group_size, of_groups % self.group_size
        hidden = F.gelu(self.hidden(x) + self.of_group(group))
        within = _nats(self.in_group(hidden), code)
        return _nats(self.group(x), torch.where(codes > 0, 1 + group, 0)) + within * (codes > 0)

    @property
    def flops(self) -> int:
        """Floating-point operations of the logits of all codes at one position."""
        return 2 * self.width * (1 + self.num_groups + self.width + self.num_groups * self.group_size)


class SharedEmbedding(nn.Module):
    """What the features of each code add to the vector that stands for it.

    Args:
        features: features of every code.
        width: length of the vector that stands for a code.
    """

    features: Tensor

    def __init__(self, features: Float[Tensor, "K F"], width: int) -> None:
        super().__init__()
        scaled = features * (_FEATURES_LENGTH / features.norm(dim=1, keepdim=True))
        self.register_buffer("features", scaled, persistent=False)
        self.embedding = nn.Parameter(torch.randn(features.shape[1], width) * 0.1)

    def forward(self) -> Float[Tensor, "K C"]:
        """Return the vectors of all codes."""
        return self.features @ self.embedding


def _nats(logits: Float[Tensor, "B T N"], chosen: Int[Tensor, "B T"]) -> Float[Tensor, "B T"]:
    return F.cross_entropy(logits.float().flatten(0, 1), chosen.flatten(), reduction="none").view_as(chosen)

"""Labels that were found, and true ones → the intersection over the union of each group of classes."""

from typing import Any, get_args

import torch
from jaxtyping import Float64, Int
from torch import Tensor

from lidargrit.scans.classes import CLASSES, Group

GROUPS = tuple(group for group in get_args(Group) if group)
_GROUP_OF = torch.zeros(max(CLASSES) + 1, dtype=torch.int64)
for _number, _class in CLASSES.items():
    _GROUP_OF[_number] = GROUPS.index(_class.group) + 1 if _class.group else 0


class LabelScores:
    """Counts of points by true and found group of classes, over scans.

    Points whose true class is in no group do not count. A found class of no group is wrong.

    Source:
        the mean intersection over union of Behley et al., SemanticKITTI, ICCV 2019, over coarser classes.
    """

    def __init__(self) -> None:
        size = len(GROUPS) + 1
        self.counts = torch.zeros(size, size, dtype=torch.int64)
        """Number of points by true group (rows) and found group (columns); the first of each is no group."""

    def add(self, found: Int[Tensor, " n"], true: Int[Tensor, " n"]) -> None:
        """Count the points of a scan, of labels by SemanticKITTI's numbers."""
        pairs = _GROUP_OF[true.long()] * len(self.counts) + _GROUP_OF[found.long()]
        self.counts += pairs.bincount(minlength=self.counts.numel()).view_as(self.counts)

    def intersection_over_union(self) -> dict[str, float]:
        """Return the score of each group of which there are true points, in [0, 1]."""
        counts: Float64[Tensor, "g g"] = self.counts[1:].double()
        right, true, found = counts[:, 1:].diagonal(), counts.sum(1), counts[:, 1:].sum(0)
        scores = right / (true + found - right).clamp(min=1)
        return {group: float(scores[at]) for at, group in enumerate(GROUPS) if true[at] > 0}

    def mean(self) -> float:
        """Return the mean over the groups of which there are true points; NaN without any."""
        each = self.intersection_over_union().values()
        return sum(each) / len(each) if each else float("nan")

    def as_table(self) -> str:
        """Return the scores as lines for a person."""
        rows = [*self.intersection_over_union().items(), ("mean", self.mean())]
        return "\n".join(f"{name:<16}{value:>6.3f}" for name, value in rows)

    def as_json(self) -> dict[str, Any]:
        """Return the scores and the counts as plain values."""
        return {
            "intersection_over_union": self.intersection_over_union(),
            "mean": self.mean(),
            "groups": ["", *GROUPS],
            "points_by_true_and_found_group": self.counts.tolist(),
        }

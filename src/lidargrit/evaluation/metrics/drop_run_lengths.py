"""Lengths of the runs of dropped pixels along rows: two sets → Jensen-Shannon distance of their distributions."""

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from lidargrit.evaluation.metrics import ImageKind
from lidargrit.evaluation.metrics.shared.curves import CurveMetric, histogram, middles
from lidargrit.scans.types import RangeImage


class DropRunLengths(CurveMetric):
    """Compare how long runs of pixels without a return are, for whatever cause, the sky included.

    Rows are circular: a run over the seam is one. Every run counts once, whatever its length; a row without any return
    is one run. Bins grow by the root of two. If only one set has runs the distance is 1.
    """

    title = "Lengths of runs of drops along rows"
    measures_raydrop = True
    axis_label = "length of a run [pixels]"
    curve_label = "share of runs"

    def count(self, images: RangeImage) -> Int64[np.ndarray, " bins"]:
        """Count the runs in bins of length."""
        return histogram(run_lengths(images.return_mask).float(), _edges(ImageKind.of(images.sensor)))

    def axis(self, kind: ImageKind) -> Float64[np.ndarray, " bins"]:
        """Return lengths of runs."""
        return middles(_edges(kind))


def _edges(kind: ImageKind) -> Float64[np.ndarray, " edges"]:
    steps = np.round(2 ** np.arange(0, np.log2(kind.width), 0.5))
    return np.append(np.unique(steps), kind.width + 1) - 0.5  # lengths are whole numbers


def run_lengths(return_mask: Bool[Tensor, "B H W"]) -> Int64[Tensor, " runs"]:
    """Return the lengths of all runs without a return along circular rows."""
    width = return_mask.shape[-1]
    rows = return_mask.reshape(-1, width)
    some = rows.any(dim=1)
    whole = torch.full((int((~some).sum()),), width)
    rows = rows[some]
    # Turned so that each begins with a return, no run reaches over the end of a row, and all rows are read as one.
    turn = rows.int().argmax(dim=1, keepdim=True)
    line = rows.gather(1, (torch.arange(width) + turn) % width).flatten()
    returns = torch.cat((line.nonzero()[:, 0], torch.tensor([len(line)])))
    between = returns.diff() - 1
    return torch.cat((between[between > 0], whole))

"""Share of each class among the returns, by range: two sets that a segmenter labels → Jensen-Shannon distance."""

import math
from typing import Any

import numpy as np
from jaxtyping import Int64

from lidargrit.evaluation.metrics import ImageKind
from lidargrit.evaluation.metrics.shared.curves import divergence, middles, normalised, range_edges
from lidargrit.evaluation.metrics.shared.labelled import LabelMetric
from lidargrit.generation.semantic_classes import class_indices
from lidargrit.scans.classes import CLASSES, LEARNED
from lidargrit.scans.types import RangeImage

_BINS = 12  # of 120 m / 0.9 m: each reaches a half farther than the one before


class ClassJsd(LabelMetric):
    """Compare how the returns at each range divide into SemanticKITTI's 19 classes, and those of no class.

    The value is the root of the mean divergence over bins of range, each with the weight of its share of the returns,
    the mean of both sets. The details hold the share of each class by range.

    Source:
        the divergence is that of the curves' metrics; the definition is this project's.
    """

    title = "Share of each class by range"

    def summarise(self, features: RangeImage, *, real: bool) -> Int64[np.ndarray, "bins 20"]:
        """Count the returns of each class in bins of range."""
        assert features.label is not None
        returned = features.return_mask
        index = class_indices(features.label.long())[returned].numpy()
        edges = range_edges(ImageKind.of(features.sensor), _BINS)
        at = np.clip(np.searchsorted(edges, features.range_m[returned].double().numpy(), "right") - 1, 0, _BINS - 1)
        counts = np.bincount(at * (len(LEARNED) + 1) + index, minlength=_BINS * (len(LEARNED) + 1))
        return counts.reshape(_BINS, len(LEARNED) + 1)

    def compare(
        self, generated: Int64[np.ndarray, "bins 20"], real: Int64[np.ndarray, "bins 20"]
    ) -> tuple[float, dict[str, Any]]:
        """Return the distance, and the shares of both sets."""
        assert self.kind is not None
        sets = {"generated": generated, "real": real}
        names = [CLASSES[number].name for number in (0, *LEARNED)]
        details = {
            "range_m": middles(range_edges(self.kind, _BINS)).tolist(),
            "share_by_range": {
                which: dict(zip(names, np.nan_to_num(normalised(counts)).T.tolist(), strict=True))
                for which, counts in sets.items()
            },
            **self.segmenter_details(),
        }
        totals = [counts.sum(1) / max(counts.sum(), 1) for counts in sets.values()]
        weights = (totals[0] + totals[1]) / 2
        if not weights.any():
            return 0.0, details
        return math.sqrt(max(float(np.average(divergence(generated, real), weights=weights)), 0.0)), details

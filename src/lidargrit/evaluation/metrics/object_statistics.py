"""Number, size and distance of vehicles, people, poles and trunks: two sets that a segmenter labels → a distance."""

import math
from typing import Any, Final

import numpy as np
from jaxtyping import Float64

from lidargrit.evaluation.metrics.shared.curves import divergence
from lidargrit.evaluation.metrics.shared.labelled import LabelMetric
from lidargrit.evaluation.metrics.shared.objects import KINDS, objects_in
from lidargrit.scans.types import RangeImage

_EDGES: Final[dict[str, np.ndarray]] = {  # the last bin of each holds what is beyond, the first what is below
    "number_a_scan": np.array([0.0, 1, 2, 3, 5, 9, 17, 33]),
    "length_m": np.geomspace(0.1, 20, 14),
    "height_m": np.geomspace(0.1, 12, 14),
    "distance_m": np.geomspace(2, 80, 12),
    "upper_share": np.linspace(0, 1, 10, endpoint=False),
}
_BINS = max(map(len, _EDGES.values()))


class ObjectStatistics(LabelMetric):
    """Compare the objects of two sets: how many a scan, how long, how high, how far away, and how their returns lie.

    An object is a connected set of returns of one kind (:func:`.objects_in`). Of each kind two histograms are compared
    by their Jensen-Shannon divergence for every quantity. The value is the root of the mean of two parts: that of the
    number a scan, the mean over the four kinds; and that of length, height, distance and the length of an object's
    upper third as a share of its own, each kind with the weight of its share of the objects, the mean of both sets.
    The details hold the means of all quantities.

    Source:
        the definition is this project's.
    """

    title = "Number, size and distance of vehicles, people, poles and trunks"

    def summarise(self, features: RangeImage, *, real: bool) -> Float64[np.ndarray, "kinds quantities bins"]:
        """Count the objects in bins of each quantity; behind the bins stands the sum of the values."""
        found = objects_in(features)
        kept = np.zeros((len(KINDS), len(_EDGES), _BINS + 1))
        for kind in range(len(KINDS)):
            of_kind = found.kind == kind
            numbers = np.bincount(found.image[of_kind], minlength=len(features))
            shapes = (found.length_m, found.height_m, found.distance_m, found.upper_share)
            for at, values in enumerate((numbers, *(each[of_kind] for each in shapes))):
                kept[kind, at, :_BINS] = _binned(values, [*_EDGES.values()][at])
                kept[kind, at, _BINS] = values.sum()
        return kept

    def compare(
        self,
        generated: Float64[np.ndarray, "kinds quantities bins"],
        real: Float64[np.ndarray, "kinds quantities bins"],
    ) -> tuple[float, dict[str, Any]]:
        """Return the distance, and the mean of each quantity of each kind in both sets."""
        apart = divergence(generated[..., :_BINS], real[..., :_BINS])
        objects = [kept[:, 1, :_BINS].sum(1) for kept in (generated, real)]
        weights = objects[0] / max(objects[0].sum(), 1) + objects[1] / max(objects[1].sum(), 1)
        shapes = float(np.average(apart[:, 1:].mean(1), weights=weights)) if weights.any() else 0.0
        details = {"generated": _means(generated), "real": _means(real), **self.segmenter_details()}
        return math.sqrt(max((float(apart[:, 0].mean()) + shapes) / 2, 0.0)), details


def _binned(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Count values in bins that begin at the edges; what is below the first is in the first."""
    at = np.clip(np.searchsorted(edges, values, "right") - 1, 0, None)
    return np.bincount(at, minlength=_BINS)


def _means(kept: np.ndarray) -> dict[str, dict[str, float | None]]:
    """Return the mean of each quantity of each kind; None where there is no object."""
    counts = kept[..., :_BINS].sum(-1)
    means = kept[..., _BINS] / np.where(counts > 0, counts, np.nan)
    return {
        kind: {name: None if math.isnan(mean) else float(mean) for name, mean in zip(_EDGES, row, strict=True)}
        for kind, row in zip(KINDS, means, strict=True)
    }

"""Where points lie, seen from above, over a whole set: two sets → Jensen-Shannon distance of their 1.6 m cells."""

from typing import Any

import numpy as np
from jaxtyping import Int64

from lidargrit.evaluation.metrics import Metric
from lidargrit.evaluation.metrics.shared.accumulators import SumAccumulator
from lidargrit.evaluation.metrics.shared.birds_eye import (
    JSD_BOUNDS,
    VARIANTS,
    BirdsEyeHistograms,
    jensen_shannon_distance,
)
from lidargrit.scans.sensors import SensorModel


class BevJsd(Metric[Int64[np.ndarray, "B cells"], np.ndarray]):
    """Compare the points of all scans of a set together, in 100x100 cells of 1.6 m, as the paper's BEV JSD does.

    Points between 3 and 70 m are counted. The value is the square root of the Jensen-Shannon divergence in nats, from
    0 (alike) to 0.8326, the root of ln 2: the number that every program of this field prints as "JSD" of a bird's-eye
    view, so that published ones can be read against it. The paper prints it times 100. Scenes are not seen, only their
    sum; only the sum is kept.

    Args:
        variant: ``exact`` has the borders of cells in exact arithmetic. ``lidargrit``, ``r2dm`` and ``lidargen`` repeat
            these programs, which place points on a border differently; besides, ``r2dm`` leaves out returns beyond
            63 m, and ``lidargen`` moves them to 63 m, where its encoding ends. Divergences are in double precision
            throughout (R2DM's are in single).

    Source:
        Zyrianov et al., LiDARGen, ECCV 2022; hamedhaghighi/LidarGRIT@a3f86e7, kazuto1011/r2dm@ad66e71,
        vzyrianov/lidargen@4c3226c.
    """

    title = "Jensen-Shannon distance of points seen from above"
    variants = VARIANTS
    bounds = JSD_BOUNDS
    accumulator = SumAccumulator

    def extractor(self, sensor: SensorModel) -> BirdsEyeHistograms:
        """Return what counts points in cells."""
        return BirdsEyeHistograms(self.variant)

    def summarise(self, features: Int64[np.ndarray, "B cells"], *, real: bool) -> Int64[np.ndarray, "cells"]:
        """Add the counts of a batch, cell by cell."""
        return features.sum(axis=0)

    def compare(
        self, generated: Int64[np.ndarray, "cells"], real: Int64[np.ndarray, "cells"]
    ) -> tuple[float, dict[str, Any]]:
        """Return the root of the divergence in nats."""
        return jensen_shannon_distance(generated, real), {}

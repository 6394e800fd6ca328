"""Coverage (COV): the share of real clouds that are the nearest to some generated one."""

from typing import Any

import numpy as np

from lidargrit.evaluation.metrics.shared.clouds import CloudMetric
from lidargrit.evaluation.metrics.shared.matching import Clouds, nearest_between


class Coverage(CloudMetric):
    """Find for every generated scan the nearest real one by Chamfer distance; the value is the share of real ones met.

    Known as COV. It tells of variety, not of quality: scenes that look like nothing real have a nearest one too. A copy
    of the real set reaches 1; another set of the same kind and size about 0.6, for some are found twice. With fewer
    generated than real scans 1 cannot be reached.
    Which scan is nearest is decided in single precision, up to 1e-6. Time grows with the product of the numbers of
    scans.

    Args:
        variant: published way to sample points from a scan, see :class:`CloudMetric`.

    Source:
        Achlioptas et al., Learning representations and generative models for 3D point clouds, ICML 2018;
        hamedhaghighi/LidarGRIT@a3f86e7.
    """

    title = "Coverage of the real set by point clouds (Chamfer)"
    bounds = (0.0, 1.0)
    higher_is_better = True

    def compare(self, generated: Clouds, real: Clouds) -> tuple[float, dict[str, Any]]:
        """Return the share."""
        _, of_generated = nearest_between(real, generated)
        return len(np.unique(of_generated.index)) / len(real), {}

"""How near generated clouds come to each real one: two sets → mean Chamfer distance of the nearest, the paper's MD."""

from typing import Any

from lidargrit.evaluation.metrics.shared.clouds import CloudMetric
from lidargrit.evaluation.metrics.shared.matching import Clouds, nearest_between


class MinimumMatchingDistance(CloudMetric):
    """Find for every real scan the nearest generated one; the value is the mean of these Chamfer distances.

    Known as MD, MMD-CD and, wrongly abbreviated like the maximum mean discrepancy, MMD; the paper prints it times
    1000. The Chamfer distance has squared distances and both means, in units of the square of the longest range. A set
    that lacks kinds of scenes scores badly; one that adds wrong scenes does not. It falls as the generated set grows:
    only values of equally large sets can be compared. ``generated_to_real`` in the details is the mean over generated
    scans of the distance to the nearest real one.
    Which scan is nearest is decided in single precision (two candidates whose distances differ by less than 1e-6 may
    change places), and its distance taken in double. Time grows with the product of the numbers of scans.

    Args:
        variant: published way to sample points from a scan, see :class:`CloudMetric`.

    Source:
        Achlioptas et al., Learning representations and generative models for 3D point clouds, ICML 2018;
        hamedhaghighi/LidarGRIT@a3f86e7.
    """

    title = "Minimum matching distance of point clouds (Chamfer)"

    def compare(self, generated: Clouds, real: Clouds) -> tuple[float, dict[str, Any]]:
        """Return the mean over real scans, and that over generated ones in the details."""
        of_real, of_generated = nearest_between(real, generated)
        return float(of_real.distance.mean()), {"generated_to_real": float(of_generated.distance.mean())}

"""Kernel distance between the features that PointNet finds in two sets of clouds (KPD): two sets → a number."""

from lidargrit.evaluation.metrics.shared.networks.kernel import KernelMetric


class KernelPointcloudDistance(KernelMetric):
    """Compare 1808 features of every cloud, seen by a PointNet that was trained on ShapeNet.

    ``r2dm`` repeats that program's clouds (all pixels, dropped ones and what is not between 0.5 and 63 m at the origin,
    divided by 80 m) and its subsets; ``exact`` takes every return, and all pairs of scans.

    Source:
        kazuto1011/r2dm@ad66e71; Bińkowski et al., Demystifying MMD GANs, ICLR 2018.
    """

    title = "Squared kernel distance between PointNet features of clouds (KPD)"
    variants = ("r2dm", "exact")
    needs_weights = "pointnet"

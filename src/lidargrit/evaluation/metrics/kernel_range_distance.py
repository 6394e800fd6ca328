"""Kernel distance between the features that RangeNet++ finds in two sets of range images: two sets → a number."""

from lidargrit.evaluation.metrics.shared.networks.kernel import KernelMetric


class KernelRangeDistance(KernelMetric):
    """Compare 4096 features of every range image, seen by a RangeNet-53 that was trained on SemanticKITTI at 64x1024.

    Needs reflectance. ``r2dm`` takes what is not between 0.5 and 63 m for dropped, and compares subsets, as that
    program does; ``exact`` takes every return, and all pairs of scans.

    Source:
        kazuto1011/r2dm@ad66e71; Bińkowski et al., Demystifying MMD GANs, ICLR 2018.
    """

    title = "Squared kernel distance between RangeNet++ features of range images"
    variants = ("r2dm", "exact")
    needs_weights = "rangenet53"

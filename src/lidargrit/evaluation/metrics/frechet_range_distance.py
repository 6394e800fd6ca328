"""Fréchet distance between the features that RangeNet++ finds in two sets of images (FRD): two sets → a number."""

from lidargrit.evaluation.metrics.shared.networks.frechet import FrechetMetric


class FrechetRangeDistance(FrechetMetric):
    """Compare 4096 features of every range image, seen by a RangeNet-53 that was trained on SemanticKITTI at 64x1024.

    Needs reflectance. ``r2dm`` takes what is not between 0.5 and 63 m for dropped, as that program does; ``exact``
    takes every return, as LiDARGen does. Both programs put real points where they were measured, these lie on rays.

    Source:
        Zyrianov et al., LiDARGen, ECCV 2022, section 4.2; vzyrianov/lidargen@4c3226c; kazuto1011/r2dm@ad66e71.
    """

    title = "Fréchet distance between RangeNet++ features of range images (FRD)"
    variants = ("r2dm", "exact")
    needs_weights = "rangenet53"

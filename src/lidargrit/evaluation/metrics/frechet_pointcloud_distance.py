"""Fréchet distance between the features that PointNet finds in two sets of clouds (FPD): two sets → a number."""

from lidargrit.evaluation.metrics.shared.networks.frechet import FrechetMetric


class FrechetPointcloudDistance(FrechetMetric):
    """Compare 1808 features of every cloud, seen by a PointNet that was trained on ShapeNet.

    Clouds lie on the rays of the pixels. ``lidargrit`` repeats that program: all pixels, dropped ones at the origin,
    divided by the sensor's longest range; on KITTI-360 sensors what is not between 0.5 and 63 m is dropped. ``r2dm``
    does so on every sensor and divides by 80 m; that program itself compares with real points where they were
    measured, which a range image no longer knows. ``exact`` takes every return and no point for a pixel without one.
    All take the distance in the same stable form; that of the programs agrees where there are more scans than features.

    Source:
        Shu et al., TreeGAN, ICCV 2019, section 5; hamedhaghighi/LidarGRIT@a3f86e7; kazuto1011/r2dm@ad66e71.
    """

    title = "Fréchet distance between PointNet features of clouds (FPD)"
    variants = ("lidargrit", "r2dm", "exact")
    needs_weights = "pointnet"

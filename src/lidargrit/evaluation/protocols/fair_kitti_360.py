"""Ours on KITTI-360, 64x1024: test drives, whole clouds, one projection and one window of range for both sets."""

from dataclasses import replace

from lidargrit.evaluation.protocols import MetricChoice
from lidargrit.evaluation.protocols import exact as _exact

fair_kitti_360 = replace(
    _exact.exact,
    title="plain definitions on KITTI-360, 64x1024, test drives",
    metrics=(
        *_exact.exact.metrics,
        MetricChoice("frechet_pointcloud_distance", "exact"),
        MetricChoice("kernel_pointcloud_distance", "exact"),
    ),
    sensor="hdl64e_kitti_360",
    range_m=(1.45, 80.0),
    num_scans=5000,
    data_set="kitti_360",
    splits=("test", "paper/test", "lidargrit-code/test", "lidargen-code/test"),
)

"""LidarGRIT's tables on KITTI-360: 5,000 samples against 5,000 test scans, 64x1024 of 2048 rounded columns."""

from lidargrit.evaluation.protocols import MetricChoice, Protocol

lidargrit_kitti_360 = Protocol(
    title="LidarGRIT on KITTI-360, 64x1024",
    source="Haghighi et al., LidarGRIT, 2024, table 1; hamedhaghighi/LidarGRIT@a3f86e7",
    metrics=(
        MetricChoice("sliced_wasserstein", "reference"),
        MetricChoice("bev_mmd", "lidargrit"),
        MetricChoice("bev_jsd", "lidargrit"),
        MetricChoice("frechet_pointcloud_distance", "lidargrit"),
    ),
    sensor="hdl64e_kitti_360",
    columns=2048,
    column_stride=2,
    variant="reference",
    range_m=(1.45, 80.0),
    num_scans=5000,
    data_set="kitti_360",
    splits=("test", "paper/test", "lidargrit-code/test"),
    departures=(
        "the program shuffles the test scans by a seed and takes the first 5,000; here they are evenly spaced",
        "the program unprojects both sets along a measured table of angles; here along the sensor's rays",
    ),
)

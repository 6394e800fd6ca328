"""LidarGRIT's tables on KITTI odometry: 5,000 samples against 5,000 test scans, 64x256 of 2048 rounded columns."""

from lidargrit.evaluation.protocols import MetricChoice, Protocol

lidargrit_kitti_odometry = Protocol(
    title="LidarGRIT on KITTI odometry, 64x256",
    source="Haghighi et al., LidarGRIT, 2024, tables 2 and 3; hamedhaghighi/LidarGRIT@a3f86e7",
    metrics=(
        MetricChoice("sliced_wasserstein", "reference"),
        MetricChoice("minimum_matching_distance", "reference"),
        MetricChoice("point_cloud_jsd", "reference"),
        MetricChoice("frechet_pointcloud_distance", "lidargrit"),
    ),
    sensor="hdl64e_kitti_odometry",
    variant="reference",
    range_m=(0.9, 120.0),
    num_scans=5000,
    data_set="kitti_odometry",
    splits=("test", "paper/test"),
    departures=(
        "the program shuffles the test scans by a seed and takes the first 5,000; here they are evenly spaced",
        "the program unprojects both sets along a measured table of angles; here along the sensor's rays",
    ),
)

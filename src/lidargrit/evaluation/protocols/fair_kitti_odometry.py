"""Ours on KITTI odometry, 64x256: sequences 11 to 21, one projection by ring and one window of range for both sets."""

from dataclasses import replace

from lidargrit.evaluation.protocols import fair_kitti_360 as _fair

fair_kitti_odometry = replace(
    _fair.fair_kitti_360,
    title="plain definitions on KITTI odometry, 64x256, test sequences",
    sensor="hdl64e_kitti_odometry",
    range_m=(0.9, 120.0),
    data_set="kitti_odometry",
    splits=("test", "paper/test"),
)

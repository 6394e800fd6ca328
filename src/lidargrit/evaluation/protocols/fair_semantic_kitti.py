"""Ours on SemanticKITTI, 64x1024: sequence 08, on which it validates, one projection and one window for both sets."""

from dataclasses import replace

from lidargrit.evaluation.protocols import fair_kitti_360 as _fair

fair_semantic_kitti = replace(
    _fair.fair_kitti_360,
    title="plain definitions on SemanticKITTI, 64x1024, sequence 08",
    num_scans=4000,  # of 4,071
    data_set="kitti_odometry",
    splits=("val", "paper/val", "08"),
)

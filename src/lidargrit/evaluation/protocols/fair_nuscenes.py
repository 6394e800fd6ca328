"""Ours on nuScenes, 32x1024: validation scenes, a row for each laser, whole clouds, one window for both sets."""

from dataclasses import replace

from lidargrit.evaluation.protocols import fair_kitti_360 as _fair

fair_nuscenes = replace(
    _fair.fair_kitti_360,
    title="plain definitions on nuScenes, 32x1024, validation scenes",
    sensor="hdl32e",
    columns=1024,
    data_set="nuscenes",
    splits=("val", "official/val"),
)

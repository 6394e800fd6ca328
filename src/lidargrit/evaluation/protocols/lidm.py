"""LiDAR Diffusion's toolbox on KITTI-360: 2,000 samples against drive 3, 64x1024, 1 to 56 m."""

from lidargrit.evaluation.protocols import MetricChoice, Protocol

lidm = Protocol(
    title="LiDAR Diffusion's toolbox on KITTI-360, 64x1024",
    source="hancyran/LiDAR-Diffusion@4c94f10, its evaluation toolbox",
    metrics=(MetricChoice("lidm_bev_jsd", "exact"), MetricChoice("lidm_bev_matching", "exact")),
    sensor="hdl64e_kitti_360",
    range_m=(1.0, 56.0),
    num_scans=2000,
    data_set="kitti_360",
    splits=("lidm/val", "0003"),
    departures=("the distances between features of trained networks (FRID, FSVD, FPVD) are not built",),
)

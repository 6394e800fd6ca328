"""LiDAR Diffusion's toolbox on KITTI-360: 2,000 samples against drive 3, 64x1024, 1 to 56 m."""

from lidargrit.evaluation.protocols import MetricChoice, Protocol

lidm = Protocol(
    title="LiDAR Diffusion's toolbox on KITTI-360, 64x1024",
    source="hancyran/LiDAR-Diffusion@4c94f10, its evaluation toolbox",
    metrics=(MetricChoice("lidm_bev_jsd", "exact"), MetricChoice("lidm_bev_matching", "exact")),
    sensor="hdl64e_kitti_360",
    variant="clamped",
    range_m=(1.0, 56.0),
    num_scans=2000,
    data_set="kitti_360",
    splits=("lidm/val", "0003"),
    departures=(
        "a fault of the program, kept: it moves points above +3 and below -25 degrees into its outer rows",
        "the distances between features of trained networks (FRID, FSVD, FPVD) are not built",
        "the program takes points from 1 m on; here those nearer than 1.45 m are left out, and hide what lies behind",
        "the program puts the points of both sets on the edges of pixels, half a row and half a column away from their "
        "centres; here both sets lie on the rays through the centres",
        "a fault, kept: the released models learned from mirrored scans, so that their samples have no front, and are "
        "compared with scans that have one",
    ),
)

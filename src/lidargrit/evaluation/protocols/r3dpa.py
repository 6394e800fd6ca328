"""R3DPA's program on KITTI-360: 10,000 samples against drives 0 and 2, 64x1024, 1 to 56 m."""

from dataclasses import replace

from lidargrit.evaluation.protocols import MetricChoice
from lidargrit.evaluation.protocols import lidm as _lidm

r3dpa = replace(
    _lidm.lidm,
    title="R3DPA on KITTI-360, 64x1024",
    source="valeoai/R3DPA@2789885, evaluate.py, columns of its val statistics",
    metrics=(MetricChoice("lidm_bev_jsd", "exact"),),
    num_scans=10000,
    splits=("test", "paper/test", "lidargrit-code/test", "lidargen-code/test"),
    departures=(
        "a fault of the program, kept: it moves points above +3 and below -25 degrees into its outer rows",
        "the program compares the first 10,000 samples with all 30,758 scans; here with equally many, evenly spaced",
        "its MMD is LiDM's formula with cells of 5 cm in place of 50, of 2,000 samples and 1,000 scans: another number "
        "than LiDM's under one name, and not built",
        "the distances between features of trained networks (FRID, FLD, FSVD, FPVD) are not built",
        "the program takes points from 1 m on; here those nearer than 1.45 m are left out, and hide what lies behind",
    ),
)

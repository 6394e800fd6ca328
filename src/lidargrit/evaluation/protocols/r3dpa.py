"""R3DPA's program on KITTI-360: 10,000 samples against drives 0 and 2, 64x1024, 1 to 56 m."""

from dataclasses import replace

from lidargrit.evaluation.protocols import MetricChoice
from lidargrit.evaluation.protocols import lidm as _lidm

OF_BOTH_NUMBERS = (
    "a fault of the program, kept: it moves points above +3 and below -25 degrees into its outer rows",
    "the program puts the points of both sets on the edges of pixels, half a row and half a column away from their "
    "centres; here both sets lie on the rays through the centres",
    "the program takes points from 1 m on; here those nearer than 1.45 m are left out, and hide what lies behind",
)
"""Departures that the protocol of its "MMD" shares."""

r3dpa = replace(
    _lidm.lidm,
    title="R3DPA on KITTI-360, 64x1024",
    source="valeoai/R3DPA@2789885, evaluate.py, columns of its val statistics",
    metrics=(MetricChoice("lidm_bev_jsd", "exact"),),
    num_scans=10000,
    splits=("test", "paper/test", "lidargrit-code/test", "lidargen-code/test"),
    departures=(
        *OF_BOTH_NUMBERS,
        "the program compares the first 10,000 samples with all 30,758 scans; here with equally many, evenly spaced",
        "its MMD is of fewer scans: the protocol r3dpa-mmd",
        "the distances between features of trained networks (FRID, FLD, FSVD, FPVD) are not built",
    ),
)

"""LiDARGen's program on KITTI-360: 1,000 samples against drives 0 and 2, 64x1024."""

from lidargrit.evaluation.protocols import MetricChoice, Protocol

lidargen = Protocol(
    title="LiDARGen on KITTI-360, 64x1024",
    source="vzyrianov/lidargen@4c3226c, its evaluation scripts",
    metrics=(
        MetricChoice("bev_mmd", "lidargen"),
        MetricChoice("bev_jsd", "lidargen"),
        MetricChoice("frechet_range_distance", "exact"),
    ),
    sensor="hdl64e_kitti_360",
    variant="clamped",
    num_scans=1000,  # what others who used its program report; its own scripts take as many scans as there are samples
    data_set="kitti_360",
    splits=("test", "paper/test", "lidargen-code/test"),
    departures=(
        "the program shuffles the scans by a seed; here they are evenly spaced",
        "the program's Fréchet range distance takes the first 1,100 scans of each set",
        "the program puts the points of both sets on the edges of pixels, half a row and half a column away from their "
        "centres; here both sets lie on the rays through the centres",
    ),
)

"""R2DM's program on KITTI-360: 10,000 samples against all scans, 64x1024, 0.5 to 63 m."""

from lidargrit.evaluation.protocols import MetricChoice, Protocol

r2dm = Protocol(
    title="R2DM on KITTI-360, 64x1024",
    source="kazuto1011/r2dm@ad66e71, evaluate.py with its defaults",
    metrics=(
        MetricChoice("frechet_range_distance", "r2dm"),
        MetricChoice("frechet_pointcloud_distance", "r2dm"),
        MetricChoice("kernel_pointcloud_distance", "r2dm"),
        MetricChoice("bev_jsd", "r2dm"),
        MetricChoice("bev_mmd", "r2dm"),
    ),
    sensor="hdl64e_kitti_360",
    variant="clamped",
    range_m=(0.5, 63.0),
    num_scans=10000,
    data_set="kitti_360",
    splits=("all",),
    departures=(
        "the program compares features of all real scans with those of the samples; here of equally many",
        "the program puts the points of samples on the edges of pixels, half a row and half a column away from their "
        "centres, and takes the measured points of real scans; here both sets lie on the rays through the centres",
    ),
)

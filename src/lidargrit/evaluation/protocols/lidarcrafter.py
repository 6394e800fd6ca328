"""LiDARCrafter's program on nuScenes: 10,000 samples against training scans, 32x1024, 0.5 to 63 m, with its faults."""

from lidargrit.evaluation.protocols import MetricChoice, Protocol

lidarcrafter = Protocol(
    title="LiDARCrafter on nuScenes, 32x1024",
    source="worldbench/lidarcrafter@3c62da2, tools/evaluation/evaluate_our.py",
    metrics=(
        MetricChoice("frechet_pointcloud_distance", "r2dm"),
        MetricChoice("kernel_pointcloud_distance", "r2dm"),
        MetricChoice("bev_jsd", "r2dm"),
        MetricChoice("bev_mmd", "r2dm"),
    ),
    sensor="hdl32e_nuscenes",
    variant="clamped",
    range_m=(0.5, 63.0),
    num_scans=10000,
    data_set="nuscenes",
    splits=("train", "official/train"),
    first_points=26_000,
    departures=(
        "a fault of the program, kept: it compares with scans of the training split, so a model that repeats them wins",
        "a fault of the program, kept: of clouds, such as OpenDWM's and UniScene's, it scores the first 26,000 points "
        "alone",
        "a fault of the program, kept: it moves the lasers above +10 and below -30 degrees into its outer rows, and "
        "leaves a pixel empty whose nearest point is beyond the limits",
        "a fault of the program, kept: rows of 1.25 degrees for lasers 4/3 degrees apart, so that those at 0 and -20 "
        "degrees lie between two rows each, and noise decides",
        "the program takes the first 10,000 scans of its list; here they are evenly spaced",
        "the program's Fréchet range distance is by a network of its own, and is not built",
        "its files of histograms and distances could not be read: R2DM's, whose names they have, stand in for them",
        "the program compares measured points of real scans with samples on the edges of pixels, and with clouds as "
        "they are, without the limits; here all lie on the rays through the centres, within the limits",
    ),
)

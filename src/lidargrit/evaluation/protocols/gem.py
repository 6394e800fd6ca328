"""GEM's program on drives of KITTI odometry, 64x1024: its Chamfer distance, with every drop a point at the sensor."""

from lidargrit.evaluation.protocols import Protocol

gem = Protocol(
    title="GEM's Chamfer distance of forecasts, beside the same of returns alone",
    source="wuyang98/GEM@6fa73eb, vae/precompute_lidar.py, evaluation_utils.py, test_multiframe_kitti.py",
    metrics=(),
    sensor="hdl64e_kitti_360",
    variant="clamped",
    range_m=(1.45, 80.0),
    data_set="kitti_odometry",
    splits=("08", "09", "10"),
    departures=(
        "a fault of the program, kept: a pixel without a return is a point at the sensor in both clouds, a perfect "
        "match where both have any; the column beside it leaves these points out",
        "a fault of the program, kept: it moves points above +3 and below -25 degrees into its outer rows, and "
        "compares with images, not with the scans",
        "the program scores the first 500 scans of each drive, each as often as one of its windows forecasts it; here "
        "every scan with a whole past before it, once at each horizon",
        "the program's past are five scans as far apart as the forecasts are; here they follow one another",
        "its L1 and AbsRel are not built: those of the protocol forecast are of the same rays, without the clamping",
    ),
)

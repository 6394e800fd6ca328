"""Small trees of simulated scans, laid out as each data set of files that can be written is."""

from pathlib import Path

from lidargrit.data import formats
from lidargrit.data.datasets import load
from lidargrit.scans.sensors import load_sensor
from lidargrit.simulator import simulate

LOG = "00000000-0000-3000-8000-00000000000"
EXAMPLES = {  # files whose scans are written by turns
    "argoverse2": (
        f"train/{LOG}0/sensors/lidar/{{index:018d}}.feather",
        f"val/{LOG}1/sensors/lidar/{{index:018d}}.feather",
    ),
    "folder": ("{index:06d}.bin", "more/{index:06d}.bin"),
    "kitti_360": tuple(
        f"data_3d_raw/2013_05_28_drive_{drive}_sync/velodyne_points/data/{{index:010d}}.bin"
        for drive in ("0000", "0003")
    ),
    "kitti_object": ("training/velodyne/{index:06d}.bin", "testing/velodyne/{index:06d}.bin"),
    "kitti_odometry": ("sequences/00/velodyne/{index:06d}.bin", "sequences/08/velodyne/{index:06d}.bin"),
    "kitti_raw": (
        "2011_09_26/2011_09_26_drive_0001_sync/velodyne_points/data/{index:010d}.bin",
        "2011_09_28/2011_09_28_drive_0002_sync/velodyne_points/data/{index:010d}.bin",
    ),
    "nuscenes": (
        "samples/LIDAR_TOP/n001-2018-01-01-00-00-00+0000__LIDAR_TOP__{index:016d}.pcd.bin",
        "sweeps/LIDAR_TOP/n002-2018-01-01-00-00-00+0000__LIDAR_TOP__{index:016d}.pcd.bin",
    ),
    "range_images": ("drive_a/{index:06d}.png", "drive_b/{index:06d}.png"),
}


def write_example(name: str, root: Path, num_scans: int) -> None:
    """Write scans of seeds from 0 on below a root."""
    files, cls = EXAMPLES[name], load(name)
    for index in range(num_scans):
        path = root / files[index % len(files)].format(index=index)
        path.parent.mkdir(parents=True, exist_ok=True)
        writer = formats.candidates(path)[0] if name == "folder" else formats.load(cls.format)
        writer.write(path, simulate(seed=index, sensor=load_sensor(cls.sensor)))

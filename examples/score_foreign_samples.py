"""A folder of .pth files as R2DM's program writes them → scores with intervals and reference rows."""

import sys
import tempfile
from pathlib import Path

import torch

import lidargrit


def main(folder: Path) -> None:
    """Write six scans in R2DM's layout (they stand for its samples), and score them against six others."""
    with tempfile.TemporaryDirectory(dir=folder) as samples:
        write_as_r2dm_does(Path(samples), 6)
        card = lidargrit.evaluate(samples, "simulated:6:test", metrics=["bev_jsd", "return_rate_per_ring"])
    print(card.as_table())
    for warning in card.warnings:  # six scans are far too few, and it says so
        print(f"warning: {warning}")


def write_as_r2dm_does(folder: Path, count: int) -> None:
    """Write tensors of 5 channels: range in metres with 0 for no return, x, y, z, and reflectance."""
    sensor = lidargrit.load_sensor("hdl64e_kitti_360")
    for number in range(count):
        image = lidargrit.project(lidargrit.simulate(number, sensor, kept_columns_only=True), sensor)
        points_xyz_m = image.range_m[..., None] * sensor.ray_directions()
        tensor = torch.stack([image.range_m, *points_xyz_m.unbind(-1), image.reflectance])
        torch.save(tensor, folder / f"{number:010d}.pth")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

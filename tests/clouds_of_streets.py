"""Clouds of a made-up street, and small networks for them."""

import torch

from lidargrit.inference.complete import Model
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage, Scan

DENSE = load_sensor("hdl64e_kitti_odometry").with_columns(128, 4)  # a model of 32 columns, of clouds with 128
SIXTEEN = load_sensor("vlp16").with_columns(128)


def street(sensor, seed: int = 0, share: float = 0.85) -> RangeImage:
    """Return the ground and a wall around the sensor, with drops, and reflectance."""
    elevation_rad = sensor.elevation_rad.expand(sensor.height, sensor.width)
    wall_m = 12 + 4 * sensor.azimuth_rad.cos().expand_as(elevation_rad)
    ground_m = torch.where(elevation_rad < -0.02, 1.7 / -elevation_rad.clamp(max=-0.02).sin(), 1e3)
    rng = torch.Generator().manual_seed(seed)
    returned = torch.rand(elevation_rad.shape, generator=rng) < share
    bright = torch.rand(elevation_rad.shape, generator=rng)
    return RangeImage.masked(
        torch.minimum(wall_m / elevation_rad.cos(), ground_m), returned, sensor, {"reflectance": bright}
    )


def network(kind) -> Model:
    torch.manual_seed(0)
    generator = kind(kind.smallest_config(DENSE), DENSE).eval()
    return Model("a network", generator, generator.completion_sampling())


def is_kept(scan: Scan, whole: Scan, kept: torch.Tensor) -> bool:
    """Return whether a cloud begins with the points of another that stay, bit for bit."""
    count = int(kept.sum())
    return all(
        torch.equal(getattr(whole, name)[:count], getattr(scan, name)[kept])
        for name in ("points_xyz_m", "reflectance", "ring")
        if getattr(scan, name) is not None
    )

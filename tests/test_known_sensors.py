"""What fit-sensor knows of a sensor from elsewhere: that the package has it, and that its files may be mirrored."""

import math
from dataclasses import replace

import torch

from lidargrit.scans.fit_sensor import fit_sensor
from lidargrit.scans.fit_sensor.points import Points
from lidargrit.scans.fit_sensor.rings import recover_rings
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import Scan
from test_fit_sensor import room


def test_a_sensor_that_the_package_has_is_named_and_a_mirrored_file_told():
    sensor = load_sensor("vlp16").with_columns(600)
    rooms = [room(sensor, seed) for seed in range(5)]
    same = [note for note in fit_sensor(rooms).warnings if "the package has this sensor: vlp16 " in note]
    assert len(same) == 1
    assert not any("mirrored" in note for note in fit_sensor(rooms).warnings)
    mirrored = [Scan(scan.points_xyz_m * torch.tensor([1.0, -1.0, 1.0]), source="mirrored") for scan in rooms]
    assert sum("may be mirrored" in note for note in fit_sensor(mirrored).warnings) == 1
    lifted = replace(sensor, elevation_rad=sensor.elevation_rad + math.radians(1))
    others = [room(lifted, seed) for seed in range(5)]
    assert not any("the package has" in note for note in fit_sensor(others).warnings)


def test_a_file_in_which_every_other_beam_did_not_return_is_read_without_a_warning():
    azimuth_rad, range_m = torch.linspace(0, 6.28, 600), torch.tensor([10.0, 0.3]).repeat(300)  # near: no angle
    points_m = torch.stack((azimuth_rad.cos(), azimuth_rad.sin(), -0.1 - 0.1 * azimuth_rad), dim=1) * range_m[:, None]
    assert recover_rings([Points.of_scan(Scan(points_m))]) is None

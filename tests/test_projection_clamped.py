"""The ``clamped`` projection against index maps of R2DM's and LiDARGen's programs, and LiDARCrafter's formulas."""

import math

import numpy as np
import pytest
import torch

from lidargrit.scans.projection import index_map, project
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import Scan
from test_projection_reference import REAL, scan_of

ON_BORDERS = 4  # pixels in which the last bit of an arc function decides


@pytest.mark.shared
@pytest.mark.parametrize("name", ["projection_0", "projection_1", *REAL])
def test_clamped_index_map_is_the_programs(golden, shared, name):
    sensor, scan, maps = load_sensor("hdl64e_kitti_360"), scan_of(golden, shared, name), golden(name)
    range_m = np.linalg.norm(scan.points_xyz_m.numpy(), axis=1)
    ours = index_map(scan, sensor, variant="clamped")
    for key in ("r2dm_spherical_1024", "lidargen_spherical_1024"):
        theirs = maps[key]
        ties = (ours >= 0) & (theirs >= 0) & (range_m[ours] == range_m[theirs])
        assert ((ours != theirs) & ~ties).sum() <= ON_BORDERS
    returned = project(scan, sensor, variant="clamped").return_mask.numpy()
    assert (returned != (maps["r2dm_mask_spherical_1024"] > 0)).sum() <= ON_BORDERS
    if name in REAL:
        exact = index_map(scan, sensor)
        assert (exact != ours).sum() > 100, "what lies beyond the rows is in the border rows of the programs alone"


def test_points_beyond_the_rows_and_the_limits_against_lidarcrafters_formulas():
    """Each point alone, so that a slow loop is enough; then two in one pixel."""
    sensor = load_sensor("hdl32e_nuscenes")
    rng, anchor = np.random.default_rng(0), [20.0, -30.0, 1.0]  # an image has at least one return
    for _ in range(200):
        elevation, azimuth = math.radians(rng.uniform(-40, 20)), rng.uniform(-math.pi, math.pi)
        range_m = rng.uniform(1, 90)
        flat = range_m * math.cos(elevation)
        point = [flat * math.cos(azimuth), flat * math.sin(azimuth), range_m * math.sin(elevation)]
        height = 1 - (math.asin(point[2] / (range_m + 1e-6)) + math.radians(30)) / math.radians(40)
        row = min(max(math.floor(height * 32), 0), 31)
        column = math.floor((-math.atan2(point[1], point[0]) / math.pi + 1) / 2 % 1 * 1024)
        image = project(Scan(torch.tensor([point, anchor])), sensor, variant="clamped")
        assert bool(image.return_mask[row, column]) is (1.45 <= range_m <= 80)
    hidden = project(Scan(torch.tensor([[1.0, 0, 0], [9.0, 0, 0], anchor])), sensor, variant="clamped")
    assert int(hidden.return_mask.sum()) == 1, "a point that is too near hides the one behind it"

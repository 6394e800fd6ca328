"""What a run is continued with: the scans that it began with, not others of their names."""

import pytest
import torch

from lidargrit.core.errors import OutputError
from lidargrit.generation.presets import load_preset
from lidargrit.scans.sensors import load_sensor
from lidargrit.simulator import simulate
from lidargrit.training import train


def test_a_run_is_not_continued_with_other_scans_of_the_same_names(tmp_path):
    def write(seed):
        for index in range(2):
            scan = simulate(seed + index, load_sensor("hdl64e_kitti_odometry").with_columns(64))
            points = torch.cat((scan.points_xyz_m, scan.reflectance[:, None]), 1)
            (tmp_path / "scans" / f"{index}.bin").write_bytes(points.numpy().astype("<f4").tobytes())

    (tmp_path / "scans").mkdir()
    write(0)
    data = ["data.columns=64", f"data.train={tmp_path / 'scans'}", "data.val=simulated:1:val"]
    preset = load_preset("marginal", data)
    train(preset, tmp_path / "run")
    train(preset, tmp_path / "run")
    write(7)
    with pytest.raises(OutputError, match="whose run began with other train scans; wanted what it began with"):
        train(preset, tmp_path / "run")

"""What a run remembers: the scans that it began with, not others of their names, and the commit of this program."""

import shutil
import subprocess
from pathlib import Path

import pytest
import torch

from lidargrit.core.errors import OutputError
from lidargrit.generation.presets import load_preset
from lidargrit.scans.sensors import load_sensor
from lidargrit.simulator import simulate
from lidargrit.training import run, train


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


def test_the_commit_of_another_repository_is_not_ours(tmp_path, monkeypatch):
    def git(*words):
        who = ("-c", "user.name=a", "-c", "user.email=a@b")
        return subprocess.run(["git", "-C", tmp_path, *who, *words], check=True, capture_output=True, text=True).stdout

    git("init", "-q")
    git("commit", "-q", "--allow-empty", "-m", "theirs")
    (tmp_path / ".venv").mkdir()
    monkeypatch.setattr(run, "__file__", shutil.copy(str(Path(run.__file__)), tmp_path / ".venv" / "run.py"))
    assert run._commit() == "unknown"
    git("add", ".venv")
    git("commit", "-q", "-m", "ours")
    assert run._commit() == git("rev-parse", "HEAD").strip()

"""Every Python process that the program starts ignores Python files in the current folder, whoever put them there."""

import sys
from pathlib import Path

import pytest

from lidargrit.loading import DataConfig, prepare
from lidargrit.sensors import load_sensor
from lidargrit.serving.jobs import JobQueue
from lidargrit.simulator.drives import DriveConfig, write_drives
from test_generator_contract import made


@pytest.fixture
def poisoned(tmp_path, monkeypatch) -> Path:
    """Make a folder of downloads the current one; its Python files leave a trace if anything imports them."""
    folder = tmp_path / "downloads"
    folder.mkdir()
    for name in ("json", "random", "signal", "queue", "multiprocessing", "lidargrit", "numpy"):
        (folder / f"{name}.py").write_text(f"open({str(folder / f'{name}.ran')!r}, 'w').close()\n")
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    return folder


def traces(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.glob("*.ran"))


def test_serve_runs_nothing_from_the_current_folder(poisoned, tmp_path):
    made("marginal")[0].save(tmp_path / "run")
    (tmp_path / "results").mkdir()
    with JobQueue([tmp_path / "run"], tmp_path / "results") as queue:
        assert len(queue.models) == 1
    assert traces(poisoned) == []


def test_prepare_runs_nothing_from_the_current_folder(poisoned, tmp_path, monkeypatch):
    monkeypatch.setattr(sys.modules[prepare.__module__], "_SHARD_SCANS", 1)
    sensor = load_sensor("hdl64e_kitti_odometry").with_columns(64)
    prepare("simulated:2", DataConfig(workers=2), tmp_path / "prepared", sensor=sensor)
    assert traces(poisoned) == []


def test_simulate_runs_nothing_from_the_current_folder(poisoned, tmp_path):
    sensor = load_sensor("hdl64e_kitti_odometry").with_columns(64)
    write_drives(tmp_path / "drives", 2, DriveConfig(sensor), workers=2)
    assert traces(poisoned) == []

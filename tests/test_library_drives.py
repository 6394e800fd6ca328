"""Drives that libraries of their makers read: toys that the libraries write are read as they were written.

The libraries want packages that clash with ours, so these tests run in environments of their own.
"""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from lidargrit.cli import main
from lidargrit.core.errors import DataError
from lidargrit.data.datasets import open_dataset, recognise

ROWS, COLUMNS, TURN_US = 8, 12, 100_000


def turns() -> list[dict[str, np.ndarray]]:
    """Return what two turns of a LiDAR of 8 rows and 12 columns measure; every seventh ray meets nothing."""
    rng, found = np.random.default_rng(0), []
    for turn in range(2):
        row, column = (index.ravel() for index in np.mgrid[:ROWS, :COLUMNS])
        elevation, azimuth = np.radians(10 - 3 * row), np.radians(180 - 30 * column)
        direction = np.stack(
            (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)), 1
        )
        range_m, intensity = rng.uniform(2, 50, len(row)), rng.uniform(size=len(row))
        range_m[::7] = intensity[::7] = np.nan
        time_us = turn * TURN_US + column * (TURN_US // COLUMNS)
        found.append({"direction": direction, "range_m": range_m, "intensity": intensity, "time_us": time_us})
        found[-1] |= {"row": row, "column": column}
    return found


def write_ncore(folder: Path) -> None:
    v4 = pytest.importorskip("ncore.data.v4")
    from ncore.impl.common.transformations import HalfClosedInterval  # pyright: ignore[reportMissingImports]
    from upath import UPath  # pyright: ignore[reportMissingImports]

    end_us = 2 * TURN_US
    writer = v4.SequenceComponentGroupsWriter(UPath(folder), "toy", "a toy", HalfClosedInterval(0, end_us + 1), {})
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 4.0
    at = writer.register_component_writer(v4.PosesComponent.Writer, "default")
    at.store_dynamic_pose("rig", "world", poses, np.array([0, end_us], np.uint64))
    high = np.eye(4)
    high[2, 3] = 1.8
    at.store_static_pose("top", "rig", high)
    writer.register_component_writer(v4.IntrinsicsComponent.Writer, "default")
    lidars = [writer.register_component_writer(v4.LidarSensorComponent.Writer, each, "lidars") for each in ("top", "z")]
    for number, turn in enumerate(turns()):
        for lidar in lidars:
            lidar.store_frame(
                turn["direction"].astype(np.float32),
                turn["time_us"].astype(np.uint64),
                np.stack((turn["row"], turn["column"]), 1).astype(np.uint16),
                turn["range_m"][None].astype(np.float32),
                turn["intensity"][None].astype(np.float32),
                np.array([number * TURN_US, (number + 1) * TURN_US], np.uint64),
                {},
                {},
            )
    writer.finalize()


def test_a_drive_of_ncore_is_read_as_its_library_wrote_it(tmp_path, capsys):
    write_ncore(tmp_path)
    assert recognise(tmp_path) == "ncore"
    dataset = open_dataset(f"ncore:{tmp_path}")
    assert [dataset.name(index) for index in range(len(dataset))] == ["toy#0", "toy#1"]
    for index, turn in enumerate(turns()):
        scan, hit = dataset.scan(index), ~np.isnan(turn["range_m"])
        wanted = (turn["direction"] * turn["range_m"][:, None])[hit]
        np.testing.assert_allclose(scan.points_xyz_m.numpy(), wanted, rtol=1e-6, atol=1e-5)
        assert scan.ring is not None
        assert scan.reflectance is not None
        assert scan.point_time_s is not None
        assert scan.ring.tolist() == turn["row"][hit].tolist()
        np.testing.assert_allclose(scan.reflectance.numpy(), turn["intensity"][hit], rtol=1e-6)
        np.testing.assert_allclose(scan.point_time_s.numpy() * 1e6, turn["time_us"][hit] - index * TURN_US, atol=1e-6)
        assert scan.notes == ("the LiDAR 'top' is read, and not 'z'",)
        time_s, pose = dataset.motion(index)
        assert time_s == pytest.approx(0.1 * index)
        assert pose is not None
        assert torch.allclose(pose[:3, 3], torch.tensor([2.0 * index, 0, 1.8], dtype=torch.float64))
    file = next(tmp_path.glob("*lidars*"))
    file.write_bytes(file.read_bytes()[:5000])
    assert main(["inspect", f"ncore:{tmp_path}"]) == 2
    assert "which nvidia-ncore cannot read" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(("name", "file", "library"), [("ncore", "toy.ncore4.zarr.itar", "nvidia-ncore")])
def test_a_library_that_is_missing_is_asked_for(tmp_path, monkeypatch, name, file, library):
    for module in ("ncore", "ncore.data.v4"):
        monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / file).write_bytes(b"PK")
    with pytest.raises(DataError, match=f"takes {library} to read.*pip install {library}"):
        open_dataset(f"{name}:{tmp_path}")

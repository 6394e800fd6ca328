"""Drives that libraries of their makers read: toys that the libraries write are read as they were written.

The libraries want packages that clash with ours, so these tests run in environments of their own.
"""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from lidargrit.cli import main
from lidargrit.core.errors import DataError
from lidargrit.data.datasets import open_dataset, recognise
from lidargrit.data.datasets.ncore import Ncore

ROWS, COLUMNS, TURN_US = 8, 12, 100_000
TURNED, PLACE_M = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 0.0, 1.8])  # of a LiDAR on a vehicle


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


def write_123d(folder: Path, holds_points: bool = True) -> None:
    writers = pytest.importorskip("py123d.api.scene.arrow.arrow_log_writer")
    from py123d.api.scene.arrow.utils.log_writer_config import LogWriterConfig  # pyright: ignore[reportMissingImports]
    from py123d.datatypes.metadata.log_metadata import LogMetadata  # pyright: ignore[reportMissingImports]
    from py123d.datatypes.sensors import lidar  # pyright: ignore[reportMissingImports]
    from py123d.datatypes.time.timestamp import Timestamp  # pyright: ignore[reportMissingImports]
    from py123d.geometry import PoseSE3  # pyright: ignore[reportMissingImports]
    from py123d.parser.base_dataset_parser import ModalitiesSync, ParsedLidar  # pyright: ignore[reportMissingImports]

    stored = {"lidar_store_option": "binary", "lidar_codec": "ipc_zstd"} if holds_points else {}
    writer = writers.ArrowLogWriter(LogWriterConfig(**stored), folder, folder / "sensors")
    assert writer.reset(LogMetadata("toy", "toy_train", "log_1", None))
    place = PoseSE3.from_R_t(TURNED, PLACE_M)
    about = lidar.LidarMetadata("top", lidar.LidarID.LIDAR_TOP, place)
    merged = lidar.LidarMergedMetadata({lidar.LidarID.LIDAR_TOP: about})
    for number, turn in enumerate(turns()):
        hit = ~np.isnan(turn["range_m"])
        xyz_m = (turn["direction"] * turn["range_m"][:, None])[hit] @ TURNED.T + PLACE_M
        features = {"ids": np.full(len(xyz_m), 2, np.uint8), "channel": turn["row"][hit].astype(np.uint8)}
        features |= {"intensity": np.rint(turn["intensity"][hit] * 255).astype(np.uint8)}
        features |= {"timestamps": turn["time_us"][hit].astype(np.int64)}
        begun, ended = (Timestamp.from_us((number + at) * TURN_US) for at in (0, 1))
        seen = lidar.Lidar(begun, ended, merged, xyz_m.astype(np.float32), features)
        named = ParsedLidar(merged, begun, ended, folder, f"{number}.pkl.gz")
        writer.write_sync(ModalitiesSync(begun, [seen if holds_points else named]))
    writer.close()


def test_a_log_of_py123d_is_read_as_its_library_wrote_it(tmp_path):
    write_123d(tmp_path / "logs")
    assert recognise(tmp_path / "logs") == "py123d"
    dataset = open_dataset(f"py123d:{tmp_path / 'logs'}")
    assert [dataset.name(index) for index in range(len(dataset))] == ["toy_train/log_1#0", "toy_train/log_1#1"]
    for index, turn in enumerate(turns()):
        scan, hit = dataset.scan(index), ~np.isnan(turn["range_m"])
        wanted = (turn["direction"] * turn["range_m"][:, None])[hit]
        np.testing.assert_allclose(scan.points_xyz_m.numpy(), wanted, atol=1e-5)
        assert scan.ring is not None
        assert scan.reflectance is not None
        assert scan.point_time_s is not None
        assert scan.ring.tolist() == turn["row"][hit].tolist()
        np.testing.assert_allclose(scan.reflectance.numpy(), turn["intensity"][hit], atol=0.5 / 255 + 1e-6)
        np.testing.assert_allclose(scan.point_time_s.numpy() * 1e6, turn["time_us"][hit] - index * TURN_US, atol=1e-6)
        assert dataset.motion(index) == (pytest.approx(0.1 * index), None)
    write_123d(tmp_path / "paths", holds_points=False)
    with pytest.raises(DataError, match=r"names files in place of points.*lidar_store_option: binary"):
        open_dataset(f"py123d:{tmp_path / 'paths'}")


def test_all_files_of_a_drive_of_ncore_are_opened_whatever_its_name(tmp_path, monkeypatch):
    opened = []
    fake = SimpleNamespace(SequenceComponentGroupsReader=lambda files, **_: opened.extend(files) or 1 / 0)
    monkeypatch.setitem(sys.modules, "ncore.data.v4", fake)
    names = ["drive [1].ncore4-lidar.zarr.itar", "drive [1].ncore4.zarr.itar"]
    for name in (*names, "drive 1.ncore4.zarr.itar"):
        (tmp_path / name).write_bytes(b"")
    with pytest.raises(DataError, match="nvidia-ncore cannot read"):
        Ncore.scans_in(tmp_path / names[1])
    assert [path.name for path in opened] == names


@pytest.mark.parametrize(
    ("name", "file", "library"),
    [("ncore", "toy.ncore4.zarr.itar", "nvidia-ncore"), ("py123d", "toy_train/log_1/sync.arrow", "py123d")],
)
def test_a_library_that_is_missing_is_asked_for(tmp_path, monkeypatch, name, file, library):
    for module in ("ncore", "ncore.data.v4", "py123d", "py123d.api.scene.arrow.arrow_scene_builder"):
        monkeypatch.setitem(sys.modules, module, None)
    (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / file).write_bytes(b"PK")
    with pytest.raises(DataError, match=rf"takes {library} to read.*lidargrit\[{name}\]"):
        open_dataset(f"{name}:{tmp_path}")

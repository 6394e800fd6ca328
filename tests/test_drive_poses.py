"""Times and poses that data sets bring along: of each layout a tiny drive, whose scans see one point in one place."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from dataset_examples import write_example
from lidargrit.core.errors import DataError
from lidargrit.data.datasets import ScanDataset, open_dataset
from lidargrit.data.datasets.shared.odometry import motions
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.prepared.prepare import prepare

CORNER_M = np.array([12.0, 3.0, 1.0, 1.0])  # in the frame of the recording


def scan_file(path: Path, columns: int = 4) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.full((20, columns), 0.5, dtype="<f4").tofile(path)


def car_poses(count: int) -> list[np.ndarray]:
    """Return poses of a car that drives and turns."""
    found = []
    for number in range(count):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("xyz", (0.01, -0.02, 0.1 * number)).as_matrix()
        pose[:3, 3] = (0.7 * number, 0.1 * number, 0.01)
        found.append(pose)
    return found


def sensor_on_car() -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_euler("xyz", (0.02, 0.01, 0.3)).as_matrix(), (1.2, 0.1, 1.7)
    return pose


def rows(matrix: np.ndarray) -> str:
    return " ".join(f"{number:.12g}" for number in matrix[:3].ravel())


def corner_seen(dataset: ScanDataset, count: int) -> list[np.ndarray]:
    """Return where the sensor of each scan sees the corner, by the poses of the data set."""
    found = []
    for index in range(count):
        pose = dataset.motion(index).pose
        assert pose is not None
        assert pose.dtype == torch.float64
        found.append((np.linalg.inv(pose.numpy()) @ CORNER_M)[:3])
    return found


def step_s(dataset: ScanDataset) -> float:
    one, other = (dataset.motion(index).time_s for index in range(2))
    assert one is not None
    assert other is not None
    return other - one


def test_kitti_raw_has_times_of_its_own_and_poses_beside_it(tmp_path):
    drive, poses = tmp_path / "2011_09_26" / "2011_09_26_drive_0001_sync", car_poses(3)
    for number in range(3):
        scan_file(drive / "velodyne_points" / "data" / f"{number + 100:010d}.bin")
    (drive / "poses.txt").write_text("".join(f"{rows(pose)}\n" for pose in poses))
    (drive / "times.txt").write_text("0\n0.1\n0.2\n")
    scans = open_dataset(f"kitti_raw:{tmp_path}:all")
    assert [window.indices for window in scans.windows(3)] == [(0, 1, 2)]
    for seen, pose in zip(corner_seen(scans, 3), poses, strict=True):
        assert np.allclose(pose[:3, :3] @ seen + pose[:3, 3], CORNER_M[:3])


def test_kitti_360_has_the_poses_of_its_car_and_the_calibration_of_its_sensor(tmp_path):
    name, poses, camera_on_car = "2013_05_28_drive_0003_sync", car_poses(3), np.eye(4)
    camera_on_car[:3, :3], camera_on_car[:3, 3] = (
        Rotation.from_euler("xyz", (1.5, 0.1, -1.5)).as_matrix(),
        (1, 0.3, 1.4),
    )
    folder = tmp_path / "data_3d_raw" / name / "velodyne_points"
    for number in range(3):
        scan_file(folder / "data" / f"{number:010d}.bin")
    times = "".join(f"2013-05-28 08:46:0{second}.904050000\n" for second in range(3))
    (folder / "timestamps.txt").write_text(times)
    (tmp_path / "data_poses" / name).mkdir(parents=True)
    known = "".join(f"{number} {rows(poses[number])}\n" for number in (0, 2))  # not every scan has one
    (tmp_path / "data_poses" / name / "poses.txt").write_text(known)
    (tmp_path / "calibration").mkdir()
    lines = f"image_00: {rows(camera_on_car)}\nimage_01: {rows(np.eye(4))}\n"
    (tmp_path / "calibration" / "calib_cam_to_pose.txt").write_text(lines)
    sensor_from_camera = np.linalg.inv(sensor_on_car()) @ camera_on_car
    (tmp_path / "calibration" / "calib_cam_to_velo.txt").write_text(rows(sensor_from_camera) + "\n")
    scans = open_dataset(f"kitti_360:{tmp_path}:all")
    assert [scans.motion(index).time_s for index in range(3)] == [0, 1, 2]
    assert scans.motion(1).pose is None
    for index in (0, 2):
        seen = np.linalg.inv(sensor_on_car()) @ np.linalg.inv(poses[index]) @ CORNER_M
        pose = scans.motion(index).pose
        assert pose is not None
        assert np.allclose(pose.numpy() @ seen, CORNER_M, atol=1e-9)


@pytest.mark.parametrize("row", [" ".join(["0"] * 12), " ".join(["nan"] * 12), "", "no numbers"])
def test_a_damaged_calibration_of_kitti_360_is_refused(row, tmp_path):
    name = "2013_05_28_drive_0003_sync"
    scan_file(tmp_path / "data_3d_raw" / name / "velodyne_points" / "data" / "0000000000.bin")
    for file, text in (
        (f"data_poses/{name}/poses.txt", f"0 {rows(np.eye(4))}\n"),
        ("calibration/calib_cam_to_pose.txt", f"image_00: {rows(np.eye(4))}\n"),
        ("calibration/calib_cam_to_velo.txt", f"{row}\n"),
    ):
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_text(text)
    with pytest.raises(DataError, match=r"calib_cam_to_velo\.txt"):
        open_dataset(f"kitti_360:{tmp_path}:all").motion(0)


def test_nuscenes_has_poses_in_its_tables(tmp_path):
    log, poses, files = "n008-2018-08-01-15-16-36-0400", car_poses(2), []
    for number in range(2):
        files.append(f"samples/LIDAR_TOP/{log}__LIDAR_TOP__{1533151603597909 + 50_000 * number}.pcd.bin")
        scan_file(tmp_path / files[-1], 5)
    tables = tmp_path / "v1.0-mini"
    tables.mkdir()

    def posed(token: str, pose: np.ndarray, **more: object) -> dict[str, object]:
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        return {"token": token, "rotation": [w, x, y, z], "translation": pose[:3, 3].tolist(), **more}

    data = [
        {"filename": file, "ego_pose_token": f"e{n}", "calibrated_sensor_token": "s"} for n, file in enumerate(files)
    ]
    data.append({"filename": "samples/CAM_FRONT/a.jpg", "ego_pose_token": "x", "calibrated_sensor_token": "y"})
    (tables / "sample_data.json").write_text(json.dumps(data, indent=0))
    (tables / "ego_pose.json").write_text(json.dumps([posed(f"e{n}", pose) for n, pose in enumerate(poses)]))
    calibrated = [posed("s", sensor_on_car(), camera_intrinsic=[]), posed("y", np.eye(4), camera_intrinsic=[[1, 0]])]
    (tables / "calibrated_sensor.json").write_text(json.dumps(calibrated))
    scans = open_dataset(f"nuscenes:{tmp_path}:all")
    assert step_s(scans) == pytest.approx(0.05, abs=1e-6)
    for seen, pose in zip(corner_seen(scans, 2), poses, strict=True):
        x, y, z = seen  # of a file x is to the right, y ahead
        in_file = np.array([-y, x, z, 1])
        assert np.allclose(pose @ sensor_on_car() @ in_file, CORNER_M)
    here = scans.motion(0).pose
    (tables / "ego_pose.json").write_text(
        json.dumps([posed(f"e{n}", 2 * np.eye(4) - pose) for n, pose in enumerate(poses)])
    )
    assert not torch.equal(here, scans.motion(0).pose), "the tables are read again where they change"
    (tables / "ego_pose.json").write_text(
        json.dumps([posed("e0", poses[0]) | {"translation": None}, posed("e1", poses[1])])
    )
    with pytest.raises(DataError, match="whose poses cannot be used"):
        scans.motion(0)


def test_argoverse_2_has_the_poses_of_its_car(tmp_path):
    feather = pytest.importorskip("pyarrow.feather")
    arrow, poses = pytest.importorskip("pyarrow"), car_poses(2)
    log = tmp_path / "train" / "00000000-0000-3000-8000-000000000000"
    names = [315966265659883000 + 100_000_000 * number for number in range(2)]
    (log / "sensors" / "lidar").mkdir(parents=True)
    for name in names:
        (log / "sensors" / "lidar" / f"{name}.feather").write_bytes(b"ARROW1\0\0")
    quaternions = np.array([Rotation.from_matrix(pose[:3, :3]).as_quat() for pose in poses])
    columns = dict(zip(("qx", "qy", "qz", "qw"), quaternions.T, strict=True))
    columns |= dict(zip(("tx_m", "ty_m", "tz_m"), np.array([pose[:3, 3] for pose in poses]).T, strict=True))
    feather.write_feather(arrow.table({"timestamp_ns": names, **columns}), log / "city_SE3_egovehicle.feather")
    scans = open_dataset(f"argoverse2:{tmp_path}:all")
    assert step_s(scans) == pytest.approx(0.1, abs=1e-6)
    for seen, pose in zip(corner_seen(scans, 2), poses, strict=True):
        on_car = (np.linalg.inv(pose) @ CORNER_M)[:3]
        assert np.linalg.norm(seen) == pytest.approx(np.linalg.norm(on_car - (1.350180, 0, 1.640420)))
        assert np.allclose(seen, on_car - (1.350180, 0, 1.640420), atol=0.1)  # its axes are the car's to half a degree


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (0, 0, 0, np.nan), None])
def test_damaged_poses_of_argoverse_2_are_refused_where_poses_are_needed(quaternion, tmp_path):
    feather, arrow = pytest.importorskip("pyarrow.feather"), pytest.importorskip("pyarrow")
    write_example("argoverse2", tmp_path, 1)
    file = next((tmp_path / "train").iterdir()) / "city_SE3_egovehicle.feather"
    if quaternion is None:
        file.write_bytes(b"no poses")
    else:
        columns = dict(zip(("qx", "qy", "qz", "qw", "tx_m", "ty_m", "tz_m"), (*quaternion, 0, 0, 0), strict=True))
        feather.write_feather(
            arrow.table({"timestamp_ns": [0], **{key: [float(at)] for key, at in columns.items()}}), file
        )
    with pytest.raises(DataError, match=r"city_SE3_egovehicle\.feather"):
        open_dataset(f"argoverse2:{tmp_path}:all").motion(0)
    assert prepare(f"argoverse2:{tmp_path}:all", DataConfig(sensor="vlp32c"), tmp_path / "prepared").is_dir()


def test_poses_without_a_calibration_are_the_sensors_own(tmp_path):
    (tmp_path / "poses.txt").write_text(f"{rows(np.eye(4))}\n")
    (tmp_path / "times.txt").write_text("0\n")
    (known,) = motions(tmp_path)
    assert known.pose is not None
    assert torch.equal(known.pose, torch.eye(4).double())


def test_poses_of_tums_form_beside_scans_are_told_once(tmp_path, heard):
    for number in range(2):
        scan_file(tmp_path / "scans" / f"{number:06d}.bin")
    (tmp_path / "poses.txt").write_text("# time x y z qx qy qz qw\n0 0 0 0 0 0 0 1\n0.1 5 0 0 0 0 0 1\n")
    scans = open_dataset(str(tmp_path))
    assert [scans.motion(index).pose for index in range(2)] == [None, None]
    assert heard == [
        f"{tmp_path / 'poses.txt'} has poses in TUM's form, which are not taken as those of scans: "
        "KITTI's 12 numbers in a row for each scan would be; export --undo-motion takes it as it is"
    ]


@pytest.mark.parametrize("row", ["noon", "NaT"])
def test_damaged_timestamps_are_refused(row, tmp_path):
    scan_file(tmp_path / "2011_09_26" / "2011_09_26_drive_0001_sync" / "velodyne_points" / "data" / "0000000000.bin")
    (tmp_path / "2011_09_26" / "2011_09_26_drive_0001_sync" / "velodyne_points" / "timestamps.txt").write_text(
        f"{row}\n"
    )
    with pytest.raises(DataError, match=r"timestamps\.txt with a row that is no time"):
        open_dataset(f"kitti_raw:{tmp_path}:all").motion(0)

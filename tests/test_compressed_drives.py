"""Scans of a drive come back from a compressed file, each given those before it, in any order and from any machine."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from lidargrit.cli import main
from lidargrit.core.errors import ScanError
from lidargrit.data.formats.kitti_bin import KittiBin
from lidargrit.data.windows import TimedScan
from lidargrit.inference.compress.archive import Archive, add_scan, writing
from lidargrit.inference.compress.drives import DrivesOfSource, Place, PlacedScan, past_of
from lidargrit.inference.compress.scan_codec import ScanCodec
from lidargrit.scans.motion import Motion
from lidargrit.scans.projection import unproject
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.systems.forecaster.system import Forecaster
from tiny_runs import the_one_line, with_random_weights

pytest.importorskip("constriction")
SENSOR = load_sensor("hdl64e_kitti_odometry").with_columns(32)
STEP_MM, COUNT = 20, 4


def made() -> Forecaster:
    """Return a forecaster of random weights, whose probabilities depend on the past."""
    return with_random_weights(Forecaster(Forecaster.smallest_config(SENSOR), SENSOR)).eval()


def scans(count: int) -> RangeImage:
    """Return a round wall, a little nearer in each, with holes."""
    rng = torch.Generator().manual_seed(1)
    size = (count, SENSOR.height, SENSOR.width)
    wall = 12 + 5 * torch.rand((1, 1, SENSOR.width), generator=rng) - 0.3 * torch.arange(count)[:, None, None]
    return RangeImage.masked(wall.expand(size).clone(), torch.rand(size, generator=rng) < 0.8, SENSOR)


def poses(count: int) -> torch.Tensor:
    found = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    found[:, 0, 3] = 0.3 * torch.arange(count)
    return found


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> Path:
    """Return a folder with a run, the scans of a drive with poses and times, and what was compressed of these."""
    folder = tmp_path_factory.mktemp("drive")
    made().save(folder / "run")
    (folder / "drive" / "velodyne").mkdir(parents=True)
    for number, image in enumerate(scans(COUNT).range_m):
        cloud = unproject(RangeImage.masked(image, image > 0, SENSOR))
        KittiBin.write(folder / "drive" / "velodyne" / f"{number:06d}.bin", cloud)
    shutil.copytree(folder / "drive", folder / "without_poses")
    np.savetxt(folder / "drive" / "poses.txt", poses(COUNT)[:, :3].flatten(1).numpy())
    np.savetxt(folder / "drive" / "times.txt", 0.1 * np.arange(COUNT))
    assert compress(folder, "drive", "drive.lgz") == 0
    return folder


def compress(folder: Path, source: str, out: str, *words: str) -> int:
    named = [str(folder / source), str(folder / out), "--model", str(folder / "run"), "--step-mm", str(STEP_MM)]
    return main(["compress", *named, "--projection", "spherical", *words])


def restored(folder: Path, file: str, out: Path, *words: str) -> dict[str, np.ndarray]:
    assert main(["decompress", str(folder / file), str(out), "--model", str(folder / "run"), *words]) == 0
    return images_in(out)


def images_in(folder: Path) -> dict[str, np.ndarray]:
    return {path.stem: np.load(path) for path in sorted(folder.rglob("*.npy"))}


def test_scans_of_a_drive_come_back_in_any_order(drive, tmp_path):
    whole = restored(drive, "drive.lgz", tmp_path / "whole")
    assert sorted(whole) == [f"{number:06d}" for number in range(COUNT)]
    for number, image in enumerate(scans(COUNT).range_m):
        there = whole[f"{number:06d}"] > 0
        assert there.mean() > 0.5
        apart_m = np.abs(whole[f"{number:06d}"] - image.numpy())
        assert apart_m[there & (image.numpy() > 0)].max() <= STEP_MM / 2000 + 1e-5
    some = restored(drive, "drive.lgz", tmp_path / "some", "--only", "3", "1")
    assert all(np.array_equal(some[name], whole[name]) for name in ("000001", "000003"))


def test_one_left_out_is_no_past_of_those_behind_it(drive, tmp_path):
    shutil.copytree(drive / "drive", drive / "damaged")
    (drive / "damaged" / "velodyne" / "000001.bin").write_bytes(b"")
    assert compress(drive, "damaged", "fewer.lgz", "--bad-scans", "skip") == 0
    fewer = restored(drive, "fewer.lgz", tmp_path / "fewer")
    assert sorted(fewer) == ["000000", "000002", "000003"]


def test_without_poses_each_is_compressed_by_itself(drive, capsys):
    assert compress(drive, "without_poses", "alone.lgz", "-n", "2") == 0
    assert "2 scans have no time or no pose, such as velodyne/000000, and so no past" in capsys.readouterr().err


def test_a_drive_compressed_by_another_model_of_a_bundle_is_told_of_the_smaller_file(drive, tmp_path, capsys):
    bundle = drive / "bundle"
    for name in ("single", "drives"):
        shutil.copytree(drive / "run", bundle / name)
    (bundle / "bundle.json").write_text('{"sample": "single", "drive": "drives"}')
    hint = f"4 scans have times and poses: --model {bundle}/drives makes the file smaller"
    for source, model, told in (
        ("drive", bundle, True),
        ("drive", bundle / "single", False),
        ("without_poses", bundle, False),
    ):
        words = ["--model", str(model), "--step-mm", str(STEP_MM), "--projection", "spherical", "--overwrite"]
        assert main(["compress", str(drive / source), str(tmp_path / "a.lgz"), *words]) == 0
        assert (hint in capsys.readouterr().err) == told


def test_a_file_begun_by_other_poses_is_told(drive, tmp_path, monkeypatch, capsys):
    whole, calls = ScanCodec.compress, []

    def interrupted(self, image, past=None):
        calls.append(image)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return whole(self, image, past)

    monkeypatch.setattr(ScanCodec, "compress", interrupted)
    shutil.copytree(drive / "drive", drive / "moved")
    assert compress(drive, "moved", "moved.lgz") != 0
    elsewhere = poses(COUNT)
    elsewhere[:, 1, 3] = 0.01 * torch.arange(COUNT)
    np.savetxt(drive / "moved" / "poses.txt", elsewhere[:, :3].flatten(1).numpy())
    capsys.readouterr()
    assert compress(drive, "moved", "moved.lgz") == 2
    assert "which is none of these" in the_one_line(capsys.readouterr().err, "compress")


def test_another_past_is_told(drive):
    codec, images = ScanCodec(made(), STEP_MM), scans(2)
    first, second = Place(), Place.after(Motion(0.0, poses(2)[0]), Motion(0.1, poses(2)[1]), 1)
    past = past_of(second, [PlacedScan(first, codec.rounded(images[0]))])
    compressed = codec.compress(images[1], past)
    assert torch.equal(codec.decompress(compressed, past).range_m, codec.rounded(images[1]).range_m)
    assert compressed != codec.compress(images[1])
    for other in (
        None,
        past_of(second._replace(position_mm=(900, 0, 0)), [PlacedScan(first, codec.rounded(images[0]))]),
    ):
        with pytest.raises(ScanError, match="probabilities that are not those of the machine"):
            codec.decompress(compressed, other)


@pytest.mark.parametrize("data", [b"\1", b"\1" * 24, Place(1).to_bytes(), Place(quaternion=(0, 0, 0, 0)).to_bytes()])
def test_altered_places_are_told(drive, tmp_path, capsys, data):
    path = tmp_path / "bad.lgz"
    with writing(path, Archive(drive / "drive.lgz").header) as writer:
        add_scan(writer.folder, 0, ("a", "a", 1), data)
    assert main(["decompress", str(path), str(tmp_path / "out"), "--model", str(drive / "run")]) == 2
    assert "probabilities that are not those" in the_one_line(capsys.readouterr().err, "decompress")


def test_places_are_as_near_as_their_whole_numbers():
    rng = np.random.default_rng(0)
    for turn in [*Rotation.from_quat(rng.normal(size=(20, 4))), Rotation.from_rotvec([0, 0, np.pi])]:
        now = torch.eye(4, dtype=torch.float64)
        now[:3, :3], now[:3, 3] = torch.from_numpy(turn.as_matrix()), torch.from_numpy(rng.uniform(-400, 400, 3))
        place = Place.after(Motion(5.0, torch.eye(4, dtype=torch.float64)), Motion(5.1, now), 3)
        back, rest = Place.split(place.to_bytes() + b"scan")
        assert (back, rest, back.time_ms) == (place, b"scan", 100)
        assert torch.allclose(back.pose[:3, 3], now[:3, 3], atol=5.1e-4)
        assert torch.allclose(back.pose[:3, :3], now[:3, :3], atol=1e-4)
        assert torch.allclose(back.pose[:3, :3] @ back.pose[:3, :3].T, torch.eye(3, dtype=torch.float64), atol=1e-14)


def test_a_scan_needs_few_others():
    timed = [TimedScan(str(n), "drive", Motion(n / 10, torch.eye(4, dtype=torch.float64))) for n in range(150)]
    drives = DrivesOfSource(timed, 5)
    assert [n for n in range(150) if not len(drives.before(n))] == [0, 64, 128]
    assert [*drives.before(66)] == [64, 65]
    assert [*drives.before(100)] == [95, 96, 97, 98, 99]
    assert DrivesOfSource([*timed[:3], *timed[5:]], 5).before(3) == range(3, 3), "after a gap"


def test_other_threads_and_instructions_restore_the_same(drive, tmp_path):
    here = restored(drive, "drive.lgz", tmp_path / "here")
    program = (
        "import sys, torch; torch.set_num_threads(2); from lidargrit.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    words = ["decompress", str(drive / "drive.lgz"), str(tmp_path / "there"), "--model", str(drive / "run")]
    environment = {**os.environ, "ATEN_CPU_CAPABILITY": "default", "PYTHONPATH": ":".join(sys.path)}
    subprocess.run([sys.executable, "-c", program, *words], env=environment, check=True, timeout=300)
    there = images_in(tmp_path / "there")
    assert here.keys() == there.keys()
    assert all(np.array_equal(here[name], there[name]) for name in here)

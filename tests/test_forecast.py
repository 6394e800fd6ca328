"""Drives that are generated scan after scan: the same files when stopped, recorded drives that go on, refusals."""

import functools
from pathlib import Path

import numpy as np
import pytest
import torch

from lidargrit.cli import main
from lidargrit.core.determinism import scan_seed
from lidargrit.core.errors import ConfigError, DataError, OutputError
from lidargrit.data.datasets import open_dataset
from lidargrit.data.datasets.shared.odometry import write_motions
from lidargrit.data.formats.kitti_bin import KittiBin
from lidargrit.data.sources import open_images
from lidargrit.evaluation.likelihood import score_likelihood
from lidargrit.generation.generator import load_class
from lidargrit.inference.drives import continued, path_of, write_drives
from lidargrit.scans.motion import transform_between
from lidargrit.scans.past import Past
from lidargrit.scans.projection import project, unproject
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from test_forecaster import SENSOR, forecaster, street


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    forecaster().save(folder)
    return folder


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> str:
    """Return a drive of four scans, each half a metre and a little of a turn after the one before."""
    root = tmp_path_factory.mktemp("recorded")
    range_m = street(4)
    for number, image in enumerate(RangeImage(range_m, range_m > 0, SENSOR.fine())[at] for at in range(4)):
        KittiBin.write(root / "sequences" / "00" / "velodyne" / f"{number:06d}.bin", unproject(image))
    write_motions(root, "00", [pose.numpy() for pose in way(4)], [0.0, 0.2, 0.4, 0.6])
    return f"kitti_odometry:{root}:00"


@functools.cache
def way(count: int) -> list[torch.Tensor]:
    step = torch.eye(4, dtype=torch.float64)
    step[:2, :2] = torch.tensor([[0.96, -0.28], [0.28, 0.96]])
    step[0, 3] = 0.5
    return [torch.linalg.matrix_power(step, number) for number in range(count)]


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*.bin")}


def test_a_drive_that_was_stopped_goes_on_to_the_same_files(run, tmp_path):
    def write(folder: str, frames: int) -> int:
        return write_drives(forecaster(), run, tmp_path / folder, [path_of(frames)] * 2, [5, 6], path="straight")

    assert write("whole", 3) == 6
    assert write("parts", 2) == 4
    assert write("parts", 3) == 6
    assert len({*files(tmp_path / "whole").values()}) == 6
    assert files(tmp_path / "parts") == files(tmp_path / "whole")
    (tmp_path / "parts" / "sequences" / "01" / "velodyne" / "000001.bin").unlink()
    write("parts", 3)
    assert files(tmp_path / "parts") == files(tmp_path / "whole")
    with pytest.raises(OutputError, match="another 'path'"):
        write_drives(forecaster(), run, tmp_path / "parts", [path_of(3)] * 2, [5, 6], path="other")
    assert main(["sample", str(run), str(tmp_path / "verb"), "--frames", "1", "-n", "1", "--seed", "6"]) == 0
    assert [*files(tmp_path / "verb").values()] == [files(tmp_path / "whole")["sequences/01/velodyne/000000.bin"]]
    opened = open_dataset(f"kitti_odometry:{tmp_path / 'whole'}:01")
    assert opened.origin_of(opened.root) == ""
    assert load_sensor(opened.sensor).same_rays(forecaster().sensor)
    motion = opened.motion(2)
    assert motion.time_s == pytest.approx(0.2)
    assert motion.pose is not None
    assert motion.pose[:3, 3].tolist() == pytest.approx([2, 0, 0])


def test_scans_keep_the_poses_that_they_were_made_for(run, tmp_path):
    """A changed file of poses gave older scans new poses, and fewer frames took those of the last ones away."""
    path, sequence = tmp_path / "path.txt", tmp_path / "out" / "sequences" / "00"

    def write(frames: int, y_m: int) -> int:
        path.write_text(f"0 0 0 0 0 0 0 1\n1 5 {y_m} 0 0 0 0 1\n")
        return write_drives(forecaster(), run, tmp_path / "out", [path_of(frames, path)], [5], path=str(path))

    def rows() -> list[str]:
        return [line for name in ("poses.txt", "times.txt") for line in (sequence / name).read_text().splitlines()]

    assert write(3, 0) == 3
    before = rows()
    assert write(2, 0) == 2
    assert rows() == before
    assert len(before) == 2 * 3
    with pytest.raises(OutputError, match=r"000001\.bin is another scan of"):
        write(4, 9)
    assert rows() == before


def test_a_forecast_is_a_sample_given_the_scans_before_it(run, recorded, tmp_path):
    words = ["forecast", recorded, str(tmp_path / "out"), "--model", str(run), "-n", "1", "--after", "2", "--seed", "4"]
    assert main(words) == 0
    written = KittiBin.read(tmp_path / "out" / "sequences" / "00" / "velodyne" / "000000.bin")
    dataset = open_dataset(recorded)
    range_m = torch.stack([project(dataset.scan(at), SENSOR.fine()).range_m for at in (1, 2)])[None]
    poses = [pose for at in range(4) if (pose := dataset.motion(at).pose) is not None]
    transforms = torch.stack([transform_between(pose, poses[3]) for pose in poses[1:3]])[None]
    past = Past(range_m, transforms, torch.tensor([[0.4, 0.2]], dtype=torch.float64), SENSOR)
    sampled = forecaster().sample([scan_seed(4, 0)], past)[0]
    ours, wanted = ({tuple(point) for point in scan.points_xyz_m.tolist()} for scan in (written, unproject(sampled)))
    assert ours == wanted
    unfolded = project(written, SENSOR, "unfolding")  # whose rows are told by the order in which points were fired
    assert torch.equal(unfolded.return_mask, sampled.return_mask)


def test_the_likelihood_of_a_drive_is_the_sum_of_scans_given_their_pasts(recorded):
    dataset = open_dataset(recorded)
    fine_m = torch.stack([project(dataset.scan(at), SENSOR.fine()).range_m for at in range(4)])
    found = score_likelihood(forecaster(), open_images(recorded, SENSOR))
    for now in range(4):
        kept_m = fine_m[now : now + 1, :, ::4].contiguous()
        past = Past.nothing(SENSOR, 1, 1)
        if now:
            before = range(max(0, now - 2), now)  # as many as the forecaster takes
            transforms = torch.stack([torch.linalg.inv(way(4)[now]) @ way(4)[then] for then in before])[None]
            ages_s = torch.tensor([[(now - then) / 5 for then in before]], dtype=torch.float64)
            past = Past(fine_m[None, before.start : now], transforms, ages_s, SENSOR)
        bits = forecaster().bits(RangeImage(kept_m, kept_m > 0, SENSOR), condition=past).total()
        assert found.parts["mask"][now] + found.parts["range"][now] == pytest.approx(float(bits), rel=1e-4)


def test_a_drive_goes_on_by_its_own_poses_or_at_constant_speed(recorded):
    known = continued(recorded, forecaster(), 3, after=1, constant_speed=False)
    constant = continued(recorded, forecaster(), 3, after=1, constant_speed=True)
    for poses in (known.poses, constant.poses):  # all steps are alike there
        np.testing.assert_allclose(torch.stack([*poses]), torch.stack(way(5)[2:]), atol=1e-6)
    assert (known.begin_s, known.period_s) == pytest.approx((0.4, 0.2))
    assert len(known.seen) == len(continued(recorded, forecaster(), 1, after=3, constant_speed=True).seen) == 2


def test_what_cannot_be_forecast_is_told_in_one_line(run, recorded, tmp_path, capsys):
    with pytest.raises(DataError, match=r"4 scans in a row .* --after 7; wanted two scans before the first forecast"):
        continued(recorded, forecaster(), 1, after=7, constant_speed=False)
    for words in ([], ["--after", "3"]):
        assert main(["forecast", "simulated:2", str(tmp_path / "out"), "--model", str(run), *words]) == 2
        told = "got simulated:2 with 0 scans that have times and poses; wanted at least two in a row; put times.txt and"
        assert told in capsys.readouterr().err
    (tmp_path / "poses.txt").write_text("0 0 0 0 0 0 0 1\n1 5 0 0 0 0 0 1\n")
    with pytest.raises(ConfigError, match=r"30 scans, 0.1 s apart, along .* which lasts 1.0 s"):
        path_of(30, tmp_path / "poses.txt")
    assert float(path_of(11, tmp_path / "poses.txt").poses[10][0, 3]) == pytest.approx(5)
    multiscale = load_class("multiscale")
    with pytest.raises(ConfigError, match="'multiscale', which takes no past"):
        write_drives(multiscale(multiscale.smallest_config(SENSOR), SENSOR), run, tmp_path, [path_of(1)], [0])

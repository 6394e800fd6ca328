"""Labels of another numbering, and range images in another unit: told, and given no wrong meaning."""

import numpy as np
import pytest
import torch

from lidargrit.cli import main
from lidargrit.core.errors import ScanError
from lidargrit.data.formats import read_scan
from lidargrit.data.sources import open_source
from lidargrit.scans.classes import names_and_colours
from lidargrit.scans.sensors import load_sensor
from street_corner import corner, xyz_of

HDL64E = load_sensor("hdl64e_kitti_odometry")
TABLE = corner(0, HDL64E)
OF_LEARNING_MAP = np.array([1, 9, 13], np.uint32)[np.arange(len(TABLE["x"])) % 3]
TOLD = "labels from 1 to 13 are not SemanticKITTI's, which has no 9; map them to its numbers"


def tree(folder, labels):
    place = folder / "sequences" / "08"
    (place / "velodyne").mkdir(parents=True)
    (place / "labels").mkdir()
    rows = np.c_[xyz_of(TABLE).numpy(), TABLE["intensity"] / 255].astype("<f4")
    (place / "velodyne" / "000000.bin").write_bytes(rows.tobytes())
    (place / "labels" / "000000.label").write_bytes(labels.astype("<u4").tobytes())
    return str(folder)


def test_labels_of_another_numbering_are_told_and_get_no_names(tmp_path, capsys):
    source = tree(tmp_path / "kitti", OF_LEARNING_MAP)
    page = tmp_path / "v.html"
    assert main(["view", source, "-o", str(page), "--set", "data.columns=90"]) == 0
    output = capsys.readouterr()
    assert TOLD in output.out + output.err
    text = page.read_text(encoding="utf-8")
    assert '"class 9"' in text
    assert '"outlier"' not in text
    assert '"bus"' not in text
    one_file = f"{source}/sequences/08/velodyne/000000.bin"
    for words in (["export", source, str(tmp_path / "out"), "--format", "kitti_odometry"], ["inspect", one_file]):
        assert main(words) == 0
        output = capsys.readouterr()
        assert TOLD in output.out + output.err


def test_a_column_of_labels_of_another_numbering_is_told(tmp_path):
    np.savez(tmp_path / "a.npz", points=xyz_of(TABLE).numpy(), label=OF_LEARNING_MAP)
    scan = read_scan(tmp_path / "a.npz")
    assert scan.notes[-1].startswith(TOLD)
    np.savez(tmp_path / "b.npz", points=xyz_of(TABLE).numpy(), label=np.uint32(40 + (3 << 16)) + 0 * OF_LEARNING_MAP)
    assert read_scan(tmp_path / "b.npz").notes == ()


def test_names_of_semantic_kitti_stay():
    assert [name for _, name, _ in names_and_colours([10, 40, 50])] == ["car", "road", "building"]
    assert [name for _, name, _ in names_and_colours([7, 11])] == ["class 7", "class 11"]  # Cityscapes' road, building
    assert len({colour for *_, colour in names_and_colours([7, 11, 23])}) == 3


@pytest.mark.parametrize("factor", [1000, 100, 0.01])
def test_range_images_in_another_unit_are_refused_despite_a_stray_pixel(tmp_path, factor):
    sensor = load_sensor("vlp16").with_columns(90)
    range_m = np.full((16, 90), 9.0)
    for at, scale in enumerate((1, factor)):
        image = range_m * scale
        image[0, 0] = 50
        np.save(tmp_path / f"{at}.npy", image.astype(np.float32))
    images = open_source(str(tmp_path)).images(sensor)
    assert bool(images.batch([0]).return_mask.all())
    with pytest.raises(ScanError, match=r"1 of 1,440 ranges within the sensor's limits in .*1\.npy; .*check the unit"):
        images.batch([1])


def test_a_few_ranges_beyond_the_limits_are_no_other_unit_but_told(tmp_path, heard):
    image = np.full((16, 90), 9.0, np.float32)
    image[:, :40] = 200
    image[:, 80:] = 0
    np.save(tmp_path / "a.npy", image)
    loaded = open_source(str(tmp_path)).images(load_sensor("vlp16").with_columns(90)).batch([0])
    assert torch.equal(loaded.return_mask.sum(), torch.tensor(16 * 40))
    assert any("50% of the ranges of" in line and "check the unit" in line for line in heard)


def test_range_images_of_other_columns_are_exported_by_the_setting_that_names_them(tmp_path):
    np.save(tmp_path / "a.npy", np.full((64, 512), 78.264, np.float32))
    out, words = tmp_path / "out", ["--format", "npz", "--sensor", "os1_64", "--set", "data.columns=512"]
    assert main(["export", str(tmp_path / "a.npy"), str(out), *words]) == 0
    points = read_scan(out / "a.npz").points_xyz_m
    assert len(points) == 64 * 512
    assert torch.allclose(points.norm(dim=1), torch.tensor(78.264))
    elevation_deg = torch.asin(points[:, 2] / 78.264).rad2deg()
    assert elevation_deg.abs().max() == pytest.approx(16.611, abs=1e-3)

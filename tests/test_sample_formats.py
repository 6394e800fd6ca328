"""Samples of other programs: told apart, turned into metres, and never trusted."""

import contextlib
import os
import pickle
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from lidargrit.core import discovery
from lidargrit.core.errors import DataError, ScanError, UnknownNameError
from lidargrit.data.sources import open_images, open_source
from lidargrit.data.sources.sample_formats import (
    _paths,
    is_tensor_folder,
    load_sample_format,
    read_tensor,
    read_tensor_folder,
    recognise,
    samples_in,
    sensor_of_tensors,
)
from lidargrit.scans.projection import project, unproject
from lidargrit.scans.types import Scan

SIZE = (64, 1024)


def scan(seed=0, size=SIZE):
    """Metres within the limits of all, 0 where nothing returned, and reflectance."""
    rng = torch.Generator().manual_seed(seed)
    mask = torch.rand(size, generator=rng) < 0.8
    return (2 + 58 * torch.rand(size, generator=rng)) * mask, torch.rand(size, generator=rng)


def r2dm(range_m, reflectance):
    rows, columns = (torch.arange(n) / n for n in SIZE)
    pitch, yaw = torch.deg2rad(3 - 28 * rows)[:, None], torch.deg2rad(180 - 360 * columns)[None]
    x, y, z = range_m * pitch.cos() * yaw.cos(), range_m * pitch.cos() * yaw.sin(), range_m * pitch.sin()
    return torch.stack((range_m, x, y, z, reflectance))


def lidargen(range_m, reflectance):
    return torch.stack((torch.log2(range_m + 1.0001) / 6, reflectance)).clamp(0, 1)


def lidargrit(range_m, reflectance):
    return range_m[None]


WRITERS = {"r2dm": r2dm, "lidargen": lidargen, "lidargrit": lidargrit}


def write_lidm(path, range_m):
    """Write the text of LiDM's custom_to_pcd: the returns of its limits, on the first edges of their pixels."""
    row, column = (range_m > 0).nonzero().double().T
    yaw, pitch = torch.pi * (2 * column / SIZE[1] - 1), torch.deg2rad(3 - 28 * row / SIZE[0])
    metres = range_m[range_m > 0]
    points = torch.stack((yaw.cos() * pitch.cos() * metres, -yaw.sin() * pitch.cos() * metres, pitch.sin() * metres), 1)
    np.savetxt(path, np.hstack([points.numpy(), np.zeros(points.shape)]), fmt="%.3f")


def test_clouds_on_the_edges_of_pixels_keep_their_pixels(tmp_path):
    for index in (0, 1):
        write_lidm(tmp_path / f"samples_{index:06}.txt", scan(index)[0])
    assert is_tensor_folder(tmp_path)
    assert recognise(tmp_path) == "lidm"
    images = open_images(str(tmp_path))
    assert images.sensor.name == "hdl64e_kitti_360"
    batch = images.batch([0, 1])
    for index in (0, 1):
        assert torch.allclose(batch.range_m[index], scan(index)[0], atol=2e-3), "text has millimetres"
    points = torch.from_numpy(np.loadtxt(tmp_path / "samples_000000.txt")[:, :3]).float()
    plainly = project(Scan(points), images.sensor)
    assert int(plainly.return_mask.sum()) < 0.8 * len(points), "what a projection of these points would lose"


def write_r3dpa(path, scans):
    """Write img.npz as postprocess and create_npz_from_sample_folder do: depth, x, y, z, and zeros for reflectance."""
    depth = np.stack([np.where(range_m > 0, range_m, 0.3) for range_m in scans])[:, None].astype(np.float32)
    np.savez(path, arr_0=np.hstack([depth, np.ones_like(depth), -depth, depth, np.zeros_like(depth)]))


def test_the_archive_of_r3dpa_is_read_scan_by_scan(tmp_path):
    whole, tmp_path = tmp_path, tmp_path / "numpy"
    tmp_path.mkdir()
    write_r3dpa(tmp_path / "img.npz", [scan(seed)[0].numpy() for seed in (1, 2, 3)])
    (tmp_path / "samples.pcd").write_bytes(b"a pickle")
    assert len(open_images(str(whole))) == len(open_images(str(tmp_path / "img.npz"))) == 3
    (whole / "pcd").mkdir()
    write_lidm(whole / "pcd" / "000000.txt", scan(0)[0])
    assert samples_in(whole) == tmp_path
    assert samples_in(whole / "pcd") == whole / "pcd"
    for named, folder in (("r3dpa", tmp_path), ("lidm", whole / "pcd")):
        assert samples_in(whole, named) == folder
        assert open_source(str(whole), samples_format=named).sensor.name == "hdl64e_kitti_360"
    assert len(open_source(str(tmp_path / "img.npz"), samples_format="r3dpa").images()) == 3
    assert recognise(tmp_path) == "r3dpa"
    images = open_images(str(tmp_path))
    assert len(images) == 3
    assert images.sensor.name == "hdl64e_kitti_360"
    batch = images.batch([0, 1, 2])
    for index, seed in enumerate((1, 2, 3)):
        range_m = scan(seed)[0]
        assert torch.equal(batch.range_m[index], torch.where(range_m < 56, range_m, 0))
    assert batch.reflectance is None
    np.savez_compressed(tmp_path / "img.npz", arr_0=np.zeros((1, 5, 64, 1024), np.float32))
    with pytest.raises(ScanError, match="a packed array"):
        read_tensor_folder(tmp_path, "r3dpa")
    write_r3dpa(tmp_path / "img.npz", [scan(1)[0].numpy()])
    (tmp_path / "img.npz").write_bytes((tmp_path / "img.npz").read_bytes()[:700_000])
    with pytest.raises(ScanError, match="which cannot be used"):
        read_tensor_folder(tmp_path, "r3dpa")
    (tmp_path / "img.npz").unlink()
    os.mkfifo(tmp_path / "img.npz")
    assert not is_tensor_folder(tmp_path)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("1.000 2.000 0.000 0.000 0.000 0.000\n1.000 2.000\n", "which cannot be used"),
        ("1.000 2.000 0.000 0.000 0.000 0.000\n1.000 2.000 nan 0 0 0\n", "rows of 6 numbers"),
        ("10.000 0.037 0.019 0.000 0.000 0.000\n", "pixels away from edges"),
        ("0.000 0.000 0.000 0.000 0.000 0.000\n", "no point in"),
    ],
)
def test_other_text_is_refused_in_one_line(text, line, tmp_path):
    (tmp_path / "0.txt").write_text(text)
    with pytest.raises(ScanError, match=line):
        open_images(str(tmp_path))


def test_every_sample_format_is_tested():
    assert sorted([*WRITERS, "lidm", "r3dpa"]) == discovery.names("sample-formats")
    for name in discovery.names("sample-formats"):
        assert load_sample_format(name).source
        assert 20 < len(discovery.summary("sample-formats", name)) < 180


@pytest.mark.parametrize("name", WRITERS)
def test_a_folder_of_tensors_is_recognised_and_gives_metres(name, tmp_path):
    for index in (0, 2, 10):
        torch.save(WRITERS[name](*scan(index)), tmp_path / f"samples_{index}.pth")
    assert is_tensor_folder(tmp_path)
    assert recognise(tmp_path) == name
    images = open_images(str(tmp_path))
    assert len(images) == 3
    batch = images.batch([0, 1, 2])
    for number, index in enumerate((0, 2, 10)):  # by number, not by letter
        range_m, reflectance = scan(index)
        assert torch.allclose(batch.range_m[number], range_m, atol=0.01)
        if name == "lidargrit":
            assert batch.reflectance is None
        else:
            assert torch.allclose(batch.reflectance[number], reflectance * (range_m > 0))
    assert images.sensor.name == "hdl64e_kitti_360"
    assert torch.equal(open_source(str(tmp_path), samples_format=name).images().batch([0]).range_m, batch.range_m[:1])


def test_points_of_r2dm_lie_half_a_cell_from_its_own(tmp_path):
    range_m, reflectance = scan(1)
    tensor = r2dm(range_m, reflectance)
    torch.save(tensor, tmp_path / "samples_0000000000.pth")
    ours = unproject(read_tensor_folder(tmp_path).batch([0])[0]).points_xyz_m
    theirs = tensor[1:4, range_m > 0].T
    apart = torch.linalg.vector_norm(ours - theirs, dim=1) / range_m[range_m > 0]
    half_cell = (torch.deg2rad(torch.tensor([28 / 64 / 2, 360 / 1024 / 2])) ** 2).sum().sqrt()
    assert bool((apart < half_cell * 1.01).all())
    assert bool((apart > half_cell * 0.7).all())


def test_a_file_may_hold_a_batch_of_scans(tmp_path):
    torch.save(torch.stack([lidargen(*scan(i)) for i in range(3)]), tmp_path / "samples.pth")
    torch.save(torch.stack([lidargen(*scan(i)) for i in range(3, 4)]), tmp_path / "samples2.pth")
    images = read_tensor_folder(tmp_path, count=2)
    assert len(images) == 2
    assert torch.allclose(images.batch([1]).range_m[0], scan(2)[0], atol=0.01), "evenly spaced over the files"


def test_an_empty_first_file_tells_the_sensor_too(tmp_path):
    whole = torch.stack([lidargen(*scan(i)) for i in range(2)])
    torch.save(whole[:0], tmp_path / "samples_0.pth")
    torch.save(whole, tmp_path / "samples_1.pth")
    assert sensor_of_tensors(tmp_path).same_rays(read_tensor_folder(tmp_path).sensor)


def test_a_tensor_with_a_gradient_is_read(tmp_path):
    torch.save(lidargrit(*scan()).requires_grad_(), tmp_path / "0.pth")
    assert torch.equal(open_images(str(tmp_path)).batch([0]).range_m[0], lidargrit(*scan())[0])


def test_batches_of_no_scan_or_of_no_shape_are_refused(tmp_path):
    torch.save(torch.zeros(0, 1, *SIZE), tmp_path / "0.pth")
    with pytest.raises(DataError, match="no scan in"):
        read_tensor_folder(tmp_path)
    torch.save(lidargrit(*scan())[None], tmp_path / "0.pth")
    torch.save(torch.tensor(1.0), tmp_path / "1.pth")
    with pytest.raises(ScanError, match=r"a tensor of \(\) in .*1\.pth; wanted a batch of scans"):
        read_tensor_folder(tmp_path)


def test_files_of_the_same_number_are_in_the_order_of_their_names(tmp_path, monkeypatch):
    for name in ("b_10.pth", "b_2.pth", "a_2.pth", "a_10.pth"):
        (tmp_path / name).write_bytes(b"")
    plain = Path.glob
    for turned in (False, True):  # file systems have orders of their own
        listed = sorted(plain(tmp_path, "*.pth"), reverse=turned)
        monkeypatch.setattr(Path, "glob", lambda *_, listed=listed: iter(listed))
        assert [path.stem for path in _paths(tmp_path)] == ["a_2", "b_2", "a_10", "b_10"]


def test_the_small_images_of_lidargrit_are_by_ring(tmp_path):
    torch.save(lidargrit(*scan(size=(64, 256))), tmp_path / "0.pth")
    assert read_tensor_folder(tmp_path).sensor.projection == "unfolding"


class Evil:
    def __reduce__(self):
        return (print, ("this must not run",))


def test_no_code_of_a_stranger_runs(tmp_path, capsys):
    torch.save({"a": Evil()}, tmp_path / "0.pth", pickle_module=pickle)
    with pytest.raises(ScanError, match=r"0\.pth, which cannot be used"):
        read_tensor(tmp_path / "0.pth")
    assert "must not run" not in capsys.readouterr().out


def nested() -> torch.Tensor:
    with warnings.catch_warnings(action="ignore"):  # of a prototype
        return torch.nested.nested_tensor([torch.zeros(2, 3), torch.zeros(4, 3)])


@pytest.mark.parametrize(
    "what", ["text", "cut", "no tensor", "swollen", "bomb", "whole numbers", "empty", "sparse", "meta", "nested"]
)
def test_what_is_no_tensor_is_refused(what, tmp_path, monkeypatch):
    monkeypatch.setattr("lidargrit.data.sources.sample_formats._BYTES_AT_MOST", 16 << 20)
    path = tmp_path / "0.pth"
    contents = {
        "no tensor": {"a": 1},
        "swollen": torch.zeros(1).expand(1 << 20),
        "whole numbers": torch.zeros(5, 64, 1024, dtype=torch.int64),
        "sparse": torch.zeros(5, 64).to_sparse(),
        "meta": torch.zeros(5, 64, 1024, device="meta"),
        "nested": nested(),
    }
    torch.save(contents.get(what, torch.zeros(5, 64, 1024)), path)
    if what == "text":
        path.write_text("hello")
    elif what == "empty":
        path.write_bytes(b"")
    elif what == "cut":
        path.write_bytes(path.read_bytes()[:-5000])
    elif what == "bomb":
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("archive/data/0", "w") as file:
            for _ in range(17):
                file.write(bytes(1 << 20))
    with pytest.raises(ScanError, match="wanted one tensor of at most 16 MB"):
        read_tensor(path)


@pytest.mark.parametrize("seed", range(40))
def test_flipped_bytes_never_crash(seed, tmp_path):
    path = tmp_path / "0.pth"
    torch.save(lidargrit(*scan(size=(64, 256))), path)
    data = bytearray(path.read_bytes())
    rng = torch.Generator().manual_seed(seed)
    ends = list(range(600)) + list(range(len(data) - 600, len(data)))  # where everything but the pixels is
    for number in torch.randint(len(ends), (5,), generator=rng).tolist():
        data[ends[number]] = int(torch.randint(256, (1,), generator=rng))
    path.write_bytes(bytes(data))
    with contextlib.suppress(ScanError):
        read_tensor_folder(tmp_path).batch([0])


def test_other_sizes_numbers_and_names_are_refused(tmp_path):
    with pytest.raises(DataError, match=r"no \.pth file"):
        read_tensor_folder(tmp_path, "r2dm")
    with pytest.raises(UnknownNameError, match="lidargen"):
        load_sample_format("lidagen")
    torch.save(torch.zeros(5, 16, 1024), tmp_path / "0.pth")
    with pytest.raises(ScanError, match="wanted 5x64x1024 or 5x32x1024"):
        read_tensor_folder(tmp_path)
    torch.save(torch.zeros(3, 64, 1024), tmp_path / "0.pth")
    with pytest.raises(ScanError, match=r"5 channels \(r2dm\)"):
        read_tensor_folder(tmp_path)
    torch.save(torch.full((1, 64, 1024), torch.nan), tmp_path / "0.pth")
    torch.save(torch.zeros(1, 64, 256), tmp_path / "1.pth")
    images = read_tensor_folder(tmp_path)
    with pytest.raises(ScanError, match="negative or no number"):
        images.batch([0])
    with pytest.raises(ScanError, match="1x64x1024, as the first"):
        images.batch([1])


def test_weights_beside_scans_make_no_samples_of_them(tmp_path):
    torch.save({"weight": torch.zeros(2)}, tmp_path / "model.pth")
    assert is_tensor_folder(tmp_path)
    np.zeros((64, 4), np.float32).tofile(tmp_path / "000000.bin")
    assert not is_tensor_folder(tmp_path)

"""LAS files beside what every format promises: other versions, files that lie, and the library that may be missing."""

import struct
import sys
from io import BytesIO

import laspy
import numpy as np
import pytest
import torch

from format_examples import example
from lidargrit.core.errors import OutputError, ScanError
from lidargrit.data.formats import load, read_scan
from lidargrit.scans.types import Scan

LAS = load("las")


@pytest.fixture
def written(tmp_path):
    path = tmp_path / "scan.las"
    LAS.write(path, example(LAS, columns=8))
    return path


@pytest.mark.parametrize(("version", "kind"), [("1.2", 0), ("1.2", 3), ("1.3", 4), ("1.4", 6), ("1.4", 8)])
def test_other_versions_and_point_formats_of_another_program(version, kind, tmp_path):
    header = laspy.LasHeader(version=version, point_format=kind)
    header.scales, header.offsets = np.full(3, 0.001), np.array([10.0, -20.0, 0.5])
    header.add_extra_dim(laspy.ExtraBytesParams("reflectance", np.float32))
    header.add_extra_dim(laspy.ExtraBytesParams("echo", np.uint8))
    cloud = laspy.LasData(header)
    xyz_m = np.random.default_rng(0).uniform(-60, 60, (50, 3))
    cloud.xyz = xyz_m
    cloud.intensity = np.arange(50, dtype=np.uint16)
    cloud.reflectance = np.linspace(0, 1, 50, dtype=np.float32)
    cloud.write(str(tmp_path / "other.las"))
    scan = read_scan(tmp_path / "other.las")
    assert np.abs(scan.points_xyz_m.numpy() - xyz_m).max() < 0.00051
    assert np.allclose(scan.reflectance.numpy(), np.linspace(0, 1, 50)), "what is calibrated counts before intensity"
    assert scan.ring is None


def test_intensity_of_eight_bits_and_none(written):
    cloud = laspy.read(written)
    cloud.intensity = np.arange(len(cloud.x)) % 256
    cloud.write(str(written))
    assert torch.equal((255 * read_scan(written).reflectance).round().int(), torch.arange(len(cloud.x)).int() % 256)
    cloud.intensity[:] = 0
    cloud.write(str(written))
    assert read_scan(written).reflectance is None


@pytest.mark.parametrize(
    ("offset", "kind", "value", "text"),
    [
        (104, "<B", 0x80, r"compressed points \(LAZ\); .*unpack it"),
        (104, "<B", 11, "points of format 11"),
        (100, "<I", 2**32 - 1, "after 4294967295 records"),
        (96, "<I", 2**31, "points of 30 bytes in"),
        (105, "<H", 2**16 - 1, "points of 65535 bytes in"),
        (247, "<Q", 2**63, "9223372036854775808 points"),
        (247, "<Q", 0, "0 points"),
        (25, "<B", 9, "no LAS file"),
        (0, "<I", 0, "no LAS file"),
    ],
)
def test_headers_that_ask_for_more_than_there_is(written, offset, kind, value, text):
    data = bytearray(written.read_bytes())
    struct.pack_into(kind, data, offset, value)
    written.write_bytes(data)
    with pytest.raises(ScanError, match=text):
        read_scan(written)


def test_what_cannot_be_written_or_read(written, tmp_path, monkeypatch):
    with pytest.raises(OutputError, match="at most 214 km"):
        LAS.write(tmp_path / "far.las", Scan(torch.tensor([[3e5, 0.0, 0.0]])))
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(OutputError, match=r"pip install 'lidargrit\[las\]'"):
        LAS.write(tmp_path / "new.las", Scan(torch.ones(1, 3)))
    with pytest.raises(ScanError, match=r"pip install 'lidargrit\[las\]'"):
        read_scan(written)
    assert [path.name for path in tmp_path.iterdir()] == ["scan.las"]


def test_the_same_scan_gives_the_same_bytes(written, tmp_path):
    LAS.write(tmp_path / "again.las", example(LAS, columns=8))
    assert (tmp_path / "again.las").read_bytes() == written.read_bytes()
    with laspy.open(BytesIO(written.read_bytes())) as opened:
        assert opened.header.generating_software == "lidargrit"


def test_dim_scans_keep_their_reflectance(tmp_path):
    scan = Scan(torch.rand(5, 3) + 1, torch.tensor([0.0, 0.001, 0.002, 0.003, 0.0038]))
    LAS.write(tmp_path / "dim.las", scan)
    assert torch.equal(read_scan(tmp_path / "dim.las").reflectance, scan.reflectance)


def test_columns_whose_names_las_cannot_tell_apart_are_all_kept(tmp_path):
    """Names of extra dimensions have 32 bytes, and those of LAS itself are taken."""
    names = ["a" * 33, "a" * 34, "ä" * 20, "ä" * 21, "X", "X_2", ""]
    extra = {name: np.full(3, number, np.float32) for number, name in enumerate(names)}
    LAS.write_columns(tmp_path / "a.las", dict.fromkeys("xyz", np.zeros(3, np.float32)) | extra)
    read = laspy.read(tmp_path / "a.las")
    assert sorted(float(read[name][0]) for name in read.point_format.extra_dimension_names) == [*range(len(names))]

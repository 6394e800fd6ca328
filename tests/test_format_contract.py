"""What every file format promises; a new file in formats/ is tested here without a test being written."""

import os
import signal

import numpy as np
import pytest
import torch

from format_examples import NAMES, can_write, example, small_files, written
from lidargrit.core import discovery
from lidargrit.core.errors import OutputError, ScanError
from lidargrit.data import formats
from lidargrit.data.formats import ScanFormat, candidates, load, read_scan, stem
from lidargrit.scans.types import Scan

SECONDS_AT_MOST = 2  # a reader that waits for ever is stopped


@pytest.fixture(params=NAMES)
def cls(request) -> type[ScanFormat]:
    return load(request.param)


@pytest.fixture
def writer(cls) -> type[ScanFormat]:
    if not can_write(cls):
        pytest.skip("cannot write")
    return cls


@pytest.fixture(scope="module")
def others(tmp_path_factory) -> list[tuple[str, str, bytes]]:
    return small_files(tmp_path_factory.mktemp("others"))


@pytest.fixture
def impatient():
    def stop(signum, frame):
        pytest.fail("it waits for ever")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(SECONDS_AT_MOST)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def refusal(cls, path) -> str:
    """Return the one line with which a file is refused, by the format itself and by name."""
    with pytest.raises(ScanError) as first:
        cls.read(path)
    with pytest.raises(ScanError) as second:
        read_scan(path)
    for one in (first, second):
        assert str(path) in str(one.value), "it names the file"
        assert "\n" not in str(one.value), "it is one line"
        assert len(str(one.value)) < 400 + 2 * len(str(path))
    return str(second.value)


def test_says_what_it_is(cls):
    assert all((cls.title, cls.suffixes, cls.reflectance, cls.frame)), cls
    assert "\n" not in cls.title + cls.reflectance + cls.frame
    assert all(suffix.startswith(".") and suffix == suffix.lower() for suffix in cls.suffixes)
    assert set(cls.keeps) <= {"reflectance", "ring", "label"}
    assert cls.public_name() in NAMES
    assert 20 < len(discovery.summary("formats", cls.public_name())) < 180


def test_its_names_lead_to_it_and_lose_their_ending(cls, tmp_path):
    for suffix in cls.suffixes:
        for ending in (suffix, suffix.upper()):
            path = tmp_path / f"00.12{ending}"
            assert cls in candidates(path)
            assert stem(path) == "00.12"


def test_reads_what_it_wrote(writer, tmp_path):
    scan = example(writer)
    for suffix in writer.suffixes:
        path = written(writer, tmp_path, suffix)
        assert writer.recognises(path)
        assert formats.recognise(path) is writer
        assert formats.count_scans(path) == writer.count(path)
        first = writer.read(path)
        assert first.source == str(path)
        writer.write(path, first)
        again = writer.read(path)
        for name in ("points_xyz_m", "reflectance", "ring", "label"):
            once, twice = getattr(first, name), getattr(again, name)
            assert (once is None) == (twice is None), name
            if once is not None:
                tolerance = 0.05 if name == "points_xyz_m" else 0.003  # half precision at 60 m; 8 bits
                assert torch.allclose(once.double(), twice.double(), rtol=0, atol=tolerance), name
        near = torch.cdist(first.points_xyz_m[::50].double(), scan.points_xyz_m.double()).min(dim=1).values
        assert near.median() < (3 if writer.frame.startswith("pixels") else 0.05), "an image moves points to its rays"


def test_keeps_what_it_says_that_it_keeps(writer, tmp_path):
    scan = example(writer)
    back = writer.read(written(writer, tmp_path))
    for name in writer.keeps:
        wanted, got = getattr(scan, name), getattr(back, name)
        assert got is not None, name
        if len(back) == len(scan):
            assert torch.allclose(wanted.double(), got.double(), rtol=0, atol=0.003), name


@pytest.mark.parametrize("ending", ["pcd", "ply", "csv"])
@pytest.mark.parametrize("kind", ["<f2", ">f4", ">f8", ">u2", "<i8"])
def test_keeps_columns_of_any_type_and_name(ending, kind, tmp_path):
    """Those of a file in another format, of which a scan has room for none."""
    points = np.random.default_rng(0).uniform(1, 9, (50, 3)).astype(np.float32)
    times = (np.linspace(0, 100, 50) + (1_700_000_000_123_456_789 if kind == "<i8" else 0)).astype(kind)
    path, (form, *_) = tmp_path / f"a.{ending}", candidates(tmp_path / f"a.{ending}")
    form.write_columns(path, {"sensor id": times, **dict(zip("xyz", points.T, strict=True)), "time": times})
    again = form.read(path)
    assert np.array_equal(again.points_xyz_m.numpy(), points)
    if kind != "<i8":
        for name in ("time", "sensor_id"):
            assert np.array_equal(again.rows.columns[name].astype(kind), times)
    elif ending == "csv":  # PLY has no whole numbers of 64 bits, and readers of text take doubles
        assert f",{times[1]}\n" in path.read_text()


def test_writes_a_scan_that_has_points_and_rings_only(writer, tmp_path):
    whole = example(writer)
    path = tmp_path / f"bare{writer.suffixes[0]}"
    writer.write(path, Scan(whole.points_xyz_m, ring=whole.ring))
    assert (torch.zeros(1) if (got := writer.read(path).reflectance) is None else got).max() == 0


def test_a_format_that_cannot_write_says_so(cls, tmp_path):
    if can_write(cls):
        pytest.skip("it can")
    with pytest.raises(OutputError, match="choose another format, such as bin or ply"):
        cls.write(tmp_path / "new", example(cls))


def test_refuses_a_number_that_it_does_not_have(writer, tmp_path):
    path = written(writer, tmp_path)
    with pytest.raises(ScanError, match=str(path)):
        read_scan(path, writer.count(path))


@pytest.mark.usefixtures("impatient")
def test_refuses_what_is_no_file_and_does_not_hang(cls, tmp_path):
    ending = cls.suffixes[0]
    os.mkfifo(tmp_path / f"pipe{ending}")
    (tmp_path / f"folder{ending}").mkdir()
    (tmp_path / f"dangling{ending}").symlink_to(tmp_path / "nowhere")
    for name, what in (
        ("pipe", "not a file"),
        ("folder", "not a file"),
        ("dangling", "not there"),
        ("no", "not there"),
    ):
        path = tmp_path / f"{name}{ending}"
        assert cls.recognises(path) is False, name
        assert f"{name}{ending}, which is {what}" in refusal(cls, path)
    assert "cannot be read (File name too long)" in refusal(cls, tmp_path / f"{'long' * 100}{ending}")


def test_refuses_what_may_not_be_read(cls, tmp_path, monkeypatch):
    path = tmp_path / f"secret{cls.suffixes[0]}"
    path.write_bytes(b"secret")

    def forbid(*words, **more):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("io.open", forbid)  # in place of a mode of 0, which does not stop a superuser
    assert cls.recognises(path) is False
    assert "Permission denied" in refusal(cls, path)


def test_refuses_an_empty_file_and_noise(cls, tmp_path):
    for ending in cls.suffixes:
        path = tmp_path / f"empty{ending}"
        path.write_bytes(b"")
        assert cls.recognises(path) is False
        refusal(cls, path)
        for size in (1, 7, 80, 8000, 240_001):
            path.write_bytes(np.random.default_rng(size).bytes(size))
            assert cls.recognises(path) is False
            refusal(cls, path)


def test_a_terabyte_is_refused_without_being_read(cls, tmp_path):
    path = tmp_path / f"huge{cls.suffixes[0]}"
    with path.open("wb") as file:
        file.truncate(1 << 40)  # sparse: it takes no room on the disk
    assert cls.recognises(path) in (True, False)
    refusal(cls, path)


def test_a_cut_file_is_refused_or_holds_the_first_points(writer, tmp_path):
    for ending in writer.suffixes:
        path = written(writer, tmp_path, ending)
        whole, data = writer.read(path), path.read_bytes()
        some = np.random.default_rng(0).integers(1, len(data), 30)
        for length in {1, 2, 3, 5, 8, 13, 60, 200, len(data) - 1, *(len(data) * k // 7 for k in range(1, 7)), *some}:
            path.write_bytes(data[:length])
            assert writer.recognises(path) in (True, False)
            try:
                part = writer.read(path)
            except ScanError:
                refusal(writer, path)
            else:  # bare rows cannot tell
                assert len(part) <= len(whole), "what follows the points may be cut off"
                assert torch.equal(part.points_xyz_m, whole.points_xyz_m[: len(part)])


def test_a_file_of_another_format_is_refused_in_one_line(cls, others, tmp_path):
    refused = 0
    for name, file, data in others:
        if name == cls.public_name():
            continue
        path = tmp_path / f"{file.replace('.', '_')}{cls.suffixes[0]}"
        path.write_bytes(data)
        right = formats.recognise(path)
        if right is not cls and load(name) is right:
            continue  # told by its content: bare and KITTI's .bin have one ending
        assert cls.recognises(path) is False, file
        refusal(cls, path)
        refused += 1
    assert refused > 5

"""The file of compressed scans: what it refuses, and that an unfinished one goes on."""

import io
import json
import struct
import zipfile
from contextlib import suppress

import numpy as np
import pytest

from lidargrit.cli import main
from lidargrit.core.errors import OutputError, ScanError
from lidargrit.inference.compress.archive import Archive, add_scan, writing
from tiny_runs import the_one_line


def test_damaged_files_are_refused(tmp_path):
    path, rng = tmp_path / "scans.lgz", np.random.default_rng(0)
    with writing(path, {"step_mm": 20}) as writer:
        for number, name in enumerate(("one", "two")):
            add_scan(writer.folder, number, (name, name, 5), rng.bytes(300))
    whole = path.read_bytes()
    archive = Archive(path)
    archive.check()
    assert archive.names == ["one", "two"]
    damaged = [whole[:length] for length in range(0, len(whole), 7)] + [whole + b"\0", whole[1:]]
    for bit in rng.choice(8 * len(whole), 500, replace=False):
        altered = bytearray(whole)
        altered[bit // 8] ^= 1 << (bit % 8)
        damaged.append(bytes(altered))
    scans, refused = [archive.read(index) for index in range(2)], 0
    for content in damaged:
        path.write_bytes(content)
        with suppress(ScanError):  # but of a date or another number that nothing is read by
            refused += 1
            read = Archive(path)
            read.check()
            refused -= 1
            assert ([read.read(index) for index in range(2)], read.names) == (scans, archive.names)
    assert refused > 0.8 * len(damaged)
    for content in (whole[:-30], b"PK"):
        path.write_bytes(content)
        with pytest.raises(ScanError, match=r"cut off or altered|does not begin as a file of compressed scans"):
            Archive(path)


@pytest.mark.parametrize("line", [b"", b'["a"', b"{}\nx", b'["a", "b"]\nx', b"[" * 20000, b"[1, 2, 3]\nx"])
def test_a_damaged_scan_beside_an_unfinished_file_is_told_in_one_line(tmp_path, line):
    path = tmp_path / "scans.lgz"
    with suppress(KeyboardInterrupt), writing(path, {}) as writer:
        add_scan(writer.folder, 0, ("one", "one", 5), b"x")
        raise KeyboardInterrupt
    (tmp_path / "scans.lgz.unfinished" / "0").write_bytes(line)
    with pytest.raises(OutputError, match="remove it, and give the same command again"), writing(path, {}) as again:
        again.missing(["one"])


def archive_of(names: object, scans: dict[str, bytes], header: bytes = b'{"format": 3}', method: int = 0) -> bytes:
    """Return a file whose checksums hold, whatever it says."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, data in {"header.json": header, **scans, "names.json": json.dumps(names).encode()}.items():
            archive.writestr(name, data)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("names", "others"),
    [
        (["a", "b"], {}),  # more names than scans
        (["a", "a"], {"1": b"hello"}),
        (["a", 1], {"1": b"hello"}),
        ({"a": 0}, {}),
        (["a"], {"header": b"{}"}),
        (["a"], {"header": b'{"format": 2}'}),
        (["a"], {"header": b"[3]"}),
        (["a"], {"method": zipfile.ZIP_DEFLATED}),  # which could unpack to any size
    ],
)
def test_an_archive_that_cannot_be_is_refused(tmp_path, names, others):
    path = tmp_path / "scans.lgz"
    path.write_bytes(archive_of(["a"], {"0": b"hello"}))
    assert Archive(path).read(0) == b"hello"
    scans = {name: others.pop(name) for name in ("1",) if name in others}
    path.write_bytes(archive_of(names, {"0": b"hello", **scans}, **others))
    with pytest.raises(ScanError, match="cut off or altered"):
        Archive(path).check()


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_a_header_packed_so_that_it_would_unpack_to_any_size_is_refused(tmp_path, method):
    """Of these methods Python unpacks all at once: 5 kB that claim 60 MB took 12 GB."""
    path, whole = tmp_path / "scans.lgz", archive_of(["a"], {"0": b"hello"})
    with zipfile.ZipFile(io.BytesIO(whole)) as good, zipfile.ZipFile(path, "w") as archive:
        for name in good.namelist():
            archive.writestr(name, good.read(name), method if name == "header.json" else zipfile.ZIP_STORED)
    with pytest.raises(ScanError, match="cut off or altered"):
        Archive(path)


def test_a_scan_that_claims_to_be_larger_than_the_file_is_refused_before_it_is_read(tmp_path):
    path, right = tmp_path / "scans.lgz", archive_of(["a"], {"0": b"hello, scan"})
    sizes = struct.pack("<II", 11, 11)  # packed and unpacked, beside the scan and in the directory
    assert right.count(sizes) == 2
    path.write_bytes(right.replace(sizes, struct.pack("<II", 2**30, 2**30)))
    with pytest.raises(ScanError, match="cut off or altered"):
        Archive(path)


def test_a_file_without_scans_is_refused_in_words(tmp_path, capsys):
    path = tmp_path / "scans.lgz"
    path.write_bytes(archive_of([], {}))
    assert main(["decompress", str(path), str(tmp_path / "out"), "--only", "0"]) == 2
    assert f"no index: {path} holds no scans" in the_one_line(capsys.readouterr().err, "decompress")


def test_a_scan_takes_at_most_a_hundred_bytes_besides_its_own(tmp_path):
    path, rng, count = tmp_path / "scans.lgz", np.random.default_rng(0), 200
    with writing(path, {}) as writer:
        for number in range(count):
            facts = f"sequences/00/velodyne/{number:06}", str(number), 1
            add_scan(writer.folder, number, facts, rng.bytes(50))
    assert path.stat().st_size < count * (50 + 100) + 500


def test_an_interrupted_file_goes_on_and_ends_as_an_uninterrupted_one(tmp_path):
    rng, names = np.random.default_rng(0), ["one", "bad", "two", "three"]
    content = {name: b"" if name == "bad" else rng.bytes(200) for name in names}
    begun, whole, unfinished = tmp_path / "scans.lgz", tmp_path / "whole.lgz", tmp_path / "scans.lgz.unfinished"
    with writing(whole, {"step_mm": 20}) as writer:
        for number, name in enumerate(names):
            add_scan(writer.folder, number, (name, f"{name}, seed 4", 7), content[name])
    with suppress(KeyboardInterrupt), writing(begun, {"step_mm": 20}) as writer:
        for number, name in enumerate(names[:3]):
            add_scan(writer.folder, number, (name, f"{name}, seed 4", 7), content[name])
        raise KeyboardInterrupt
    assert not begun.exists()
    (unfinished / "1").unlink()  # as after a loss of power, or where the worker that had it died
    with pytest.raises(OutputError, match="scans of another model, step or version"), writing(begun, {"step_mm": 2}):
        pass
    with (
        pytest.raises(OutputError, match="the scan 0, one, seed 4, which is none of these"),
        writing(begun, {"step_mm": 20}) as writer,
    ):
        writer.missing(["one, seed 3"])
    with writing(begun, {"step_mm": 20}) as writer:
        assert writer.missing([f"{name}, seed 4" for name in names]) == [1, 3]
        for number in (3, 1):
            name = names[number]
            add_scan(writer.folder, number, (name, f"{name}, seed 4", 7), content[name])
    assert begun.read_bytes() == whole.read_bytes()
    assert Archive(begun).names == ["one", "two", "three"]
    assert not unfinished.exists()


def test_one_that_may_have_left_scans_out_does_not_go_on_as_one_that_refuses_them(tmp_path):
    path = tmp_path / "scans.lgz"
    for begun, then in (("skip", "refuse"), ("refuse", "skip")):
        with suppress(KeyboardInterrupt), writing(path, {}, {"bad_scans": begun}) as writer:
            add_scan(writer.folder, 0, ("one", "one", 1), b"one")
            raise KeyboardInterrupt
        if begun == "skip":
            with pytest.raises(OutputError, match=r"scans of other options \(bad_scans\)"):
                writing(path, {}, {"bad_scans": then}).__enter__()
        with writing(path, {}, {"bad_scans": "skip"}) as writer:
            assert writer.missing(["one"]) == []

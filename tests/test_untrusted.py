"""Words, JSON and arrays that others wrote: each has a bound, and each refusal is one line."""

import io
import json
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

from lidargrit.api import load_scan
from lidargrit.cli import main
from lidargrit.core.arrays import open_archive, parse_array, read_arrays
from lidargrit.core.configuration import override
from lidargrit.core.errors import CheckpointError, ConfigError, DataError, LidarGritError, ScanError, UsageError
from lidargrit.core.files import read_json, read_text, write_json
from lidargrit.core.untrusted import (
    Number,
    WholeNumber,
    check_path,
    parse_json,
    seed_number,
    seeds_in_a_row,
    user_path,
    whole_number,
)
from lidargrit.generation.generator import load_class
from lidargrit.inference.compress import archive
from lidargrit.nn.devices import usable_device


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("[" * 100_000, "nested more than 32 deep"),
        ('{"a":' * 40 + "1" + "}" * 40, "nested more than 32 deep"),
        ('{"a": NaN}', "NaN, which is not JSON"),
        ('{"a": -Infinity}', "-Infinity, which is not JSON"),
        ('{"a": 1e400}', "1e400, which no float can hold"),
        ('{"a": ' + "9" * 5000 + "}", "9, which no float can hold"),
        ('{"a": [-' + "9" * 400 + "]}", "9, which no float can hold"),  # was a traceback where a table showed it
        ("null", "null in place of an object"),
        ("[]", "a list in place of an object"),
        ('"a', "cannot be used"),
        ("", "cannot be used"),
        (b"\xff\xfe\xfd", "cannot be used"),
    ],
)
def test_json_that_is_refused_in_one_line(text, why):
    with pytest.raises(CheckpointError, match=f"got here, which .*{why}") as refused:
        parse_json(text, "here")
    assert len(str(refused.value)) < 300
    assert "\n" not in str(refused.value)


def test_json_as_deep_as_is_allowed_is_read():
    text = '{"a":' * 32 + "1" + "}" * 32
    assert json.dumps(parse_json(text, "here"), separators=(",", ":")) == text


def test_json_files_that_are_too_large_or_no_files(tmp_path):
    (tmp_path / "large.json").write_text("[" + "1," * 1000 + "1]")
    with pytest.raises(DataError, match=r"large.json, which cannot be read \(more than 1,000 bytes\)"):
        read_json(tmp_path / "large.json", list, DataError, at_most=1000)
    with pytest.raises(DataError, match=r"/dev/zero, which cannot be read \(not a file\)"):
        read_json(Path("/dev/zero"), dict, DataError)
    with pytest.raises(ConfigError, match=r"/dev/zero, which cannot be read \(not a file\)"):
        read_text(Path("/dev/zero"))
    with pytest.raises(CheckpointError, match=r"none\.json, which cannot be read \(no such file\)"):
        read_json(tmp_path / "none.json")


def test_what_is_written_as_json_is_strict_json(tmp_path):
    write_json(tmp_path / "a.json", {"a": float("nan"), "b": [1.5, float("inf")], "c": (1, None)})
    assert read_json(tmp_path / "a.json") == {"a": None, "b": [1.5, None], "c": [1, None]}


@pytest.mark.parametrize(
    ("check", "word"),
    [
        *((whole_number, word) for word in ("-1", "1e9", "99999999999999999999", "9" * 100_000, "", "x", "1.0")),
        *((seed_number, word) for word in (str(2**32), str(2**64), "-1", "x")),
        *((WholeNumber(1, 9), word) for word in ("0", "10")),
        *((Number(), word) for word in ("nan", "inf", "1e400", "-1", "x", "1" * 400)),
        *((Number(-10.0, 10.0), word) for word in ("nan", "-inf", "-10.1", "10.1", "--1")),
        *((check_path, word) for word in ("", " ", "a\0b", "\udcff", "x" * 256, "a/" * 3000)),
    ],
)
def test_words_that_are_refused_in_one_line(check, word):
    with pytest.raises(UsageError) as refused:
        check(word)
    assert len(str(refused.value)) < 200
    assert str(refused.value).isprintable()


def test_words_that_are_accepted():
    assert (whole_number("0"), whole_number("10000000"), seed_number(str(2**32 - 1))) == (0, 10_000_000, 2**32 - 1)
    assert (Number()("2e14"), Number()("0"), Number(-10.0, 10.0)("-10")) == (2e14, 0.0, -10.0)
    assert check_path("/daten/Straße") == Path("/daten/Straße")
    assert user_path("~/x").is_absolute()
    with pytest.raises(DataError, match="a home folder that is not there"):
        user_path("~nobody_of_that_name/x")


@pytest.mark.parametrize(
    ("words", "got"),
    [
        (["sample", "pretrained", "out", "-n", "99999999999999999999"], "-n 99999999999999999999"),
        (["sample", "pretrained", "out", "--seed", str(2**64)], f"--seed {2**64}"),
        (["sample", "pretrained", "out", "--device", "meta"], "device 'meta'"),
        (["evaluate", "~nobody_of_that_name/x", "y"], "home folder"),
        (["evaluate", "x" * 300, "y"], "too long"),
        (["inspect", "\udcff.bin"], "not UTF-8"),
        (["inspect", "a\0b"], "NUL"),
        (["publish", "pretrained", "out", "--notes", "/dev/zero"], "/dev/zero"),
        (["compare", "out", "lidargrit_small", "--flops", "nan"], "--flops nan"),
        (["train", "lidargrit_small", "out", "--set", "data.columns=1000000000", "--dry-run"], "1000000000 columns"),
        (["train", "lidargrit_small", "out", "--set", f"data.columns={-(2**63)}", "--dry-run"], "columns"),
        (["train", "lidargrit_small", "out", "--set", f"seed={2**64}", "--dry-run"], "seed=18446744073709551616"),
        (
            ["train", "lidargrit_small", "out", "--set", f"data.max_scans={10**20}", "--dry-run"],
            "max_scans=1000",
        ),
        (
            ["train", "lidargrit_small", "out", "--set", f"training.tokenizer.scans={10**20}", "--dry-run"],
            "tokenizer.scans=1000",
        ),
        (
            ["train", "lidargrit_small", "out", "--set", "training.tokenizer.learning_rate=.inf", "--dry-run"],
            "rate=.inf",
        ),
        (
            [
                "train",
                "lidargrit_small",
                "out",
                "--set",
                f"model.tokenizer.channel_multipliers={[1] * 900}",
                "--dry-run",
            ],
            "wanted at least 1, at most 16 values",
        ),
        (
            [
                "train",
                "lidargrit_small",
                "out",
                "--set",
                f"model.tokenizer.channel_multipliers={[1] * 100_000}",
                "--dry-run",
            ],
            "wanted at least 1, at most 16 values",
        ),
        (["sample", "pretrained", "out", "--set", "sampling.temperature=1e400"], "temperature=1e400"),
        (["sample", "pretrained", "out", "--set", f"sampling.top_k={10**20}"], "top_k=1000"),
    ],
)
def test_commands_refuse_in_one_line(words, got, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    said = capsys.readouterr().err
    assert got in said
    assert said.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_files_whose_names_are_not_utf8_are_refused_in_one_line(tmp_path, capsys):
    (tmp_path / "\udcff.bin").write_bytes(bytes(64))
    assert main(["inspect", str(tmp_path)]) == 2
    assert "which is not UTF-8" in capsys.readouterr().err


def npy(array: np.ndarray, header: dict | None = None) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    if header is None:
        return file.getvalue()
    forged = io.BytesIO()
    np.lib.format.write_array_header_1_0(forged, header)
    return forged.getvalue() + array.tobytes()


def npz(**members: bytes) -> io.BytesIO:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return file


@pytest.mark.parametrize(
    "header",
    [
        {"descr": "<f4", "fortran_order": False, "shape": (True, 4)},
        {"descr": "<f4", "fortran_order": False, "shape": (-1, 4)},
        {"descr": "<f4", "fortran_order": False, "shape": (10**12, 4)},
        {"descr": "|O", "fortran_order": False, "shape": (4,)},
        {"descr": "<f4", "fortran_order": False, "shape": (1,) * 9},
    ],
)
def test_headers_of_arrays_that_are_refused(header, tmp_path):
    data = npy(np.ones(4, np.float32), header)
    with pytest.raises(ValueError, match=r"array"):
        parse_array(data)
    (tmp_path / "scan.npy").write_bytes(data)
    with pytest.raises(ScanError, match=r"scan\.npy"):
        load_scan(tmp_path / "scan.npy")


def test_arrays_are_read_as_numpy_reads_them():
    for array in (np.arange(12, dtype="<f4").reshape(3, 4), np.asfortranarray(np.ones((2, 3))), np.zeros(0, bool)):
        assert np.array_equal(parse_array(npy(array)), array)
        assert np.array_equal(read_arrays(npz(a=npy(array)), ("a", "b"))["a"], array)


def test_an_archive_is_not_unpacked_beyond_what_is_allowed():
    bomb = npz(a=npy(np.zeros(50_000_000, np.uint8)))
    assert len(bomb.getvalue()) < 100_000
    with pytest.raises(ValueError, match="bytes in one array"):
        read_arrays(bomb, ("a",), 1_000_000)
    assert read_arrays(bomb, ("b",), 1_000_000) == {}


def test_a_member_that_is_no_array():
    with pytest.raises(ValueError, match="damaged array"):
        read_arrays(npz(a=b"not an array"), ("a",))
    with pytest.raises(ValueError, match="directory"):
        open_archive(io.BytesIO(b"not an archive, but longer than the end of one"))


def test_scans_are_counted_from_0(tmp_path):
    np.save(tmp_path / "scan.npy", np.ones((10, 3), np.float32))
    assert len(load_scan(tmp_path / "scan.npy", 0)) == 10
    for index in (-1, 1):
        with pytest.raises(ScanError, match=f"scan number {index} of .*one of its 1, counted from 0"):
            load_scan(tmp_path / "scan.npy", index)


def test_seeds_beyond_the_last_are_refused_before_anything_is_loaded(tmp_path, capsys):
    assert seeds_in_a_row(2**32 - 4, 4) == range(2**32 - 4, 2**32)
    words = ["sample", str(tmp_path / "no_run"), str(tmp_path / "out"), "-n", "4", "--seed", "4294967294"]
    assert main(words) == 2
    assert capsys.readouterr().err == (
        "lidargrit sample: got --seed 4294967294 with -n 4, of which the last scan has the seed 4294967297; "
        "wanted seeds up to 4294967295; lower one of the two\n"
    )
    assert not (tmp_path / "out").exists()


def test_a_device_without_numbers_is_refused():
    assert usable_device("cpu").type == "cpu"
    for name in ("meta", "nonsense", "cuda:99"):
        with pytest.raises(LidarGritError, match="one that PyTorch finds"):
            usable_device(name)


@pytest.mark.parametrize(
    ("generator", "name"),
    [
        ("r2dm", "steps"),
        ("r2dm", "resamples"),
        ("r2flow", "steps"),
        ("lidm", "steps"),
        ("maskgit", "steps"),
        ("dusty", "search_steps"),
        ("lidargen", "levels"),
        ("lidargen", "steps_each"),
    ],
)
def test_a_sampler_takes_no_number_of_steps_that_fills_the_memory(generator, name):
    with pytest.raises(ConfigError, match=name.removesuffix("s")):
        override(load_class(generator).Sampling(), [f"{name}={2**31}"])


def test_names_of_a_compressed_file_that_would_fill_the_memory_are_refused(tmp_path):
    path = tmp_path / "bomb.lgz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("header.json", b'{"format": 3}')
        with packed.open("names.json", "w") as names:
            for _ in range(200):
                names.write(b" " * 2**20)
    assert path.stat().st_size < 2**20
    with pytest.raises(ScanError, match="cut off or altered"):
        archive.Archive(path)
    small = path.read_bytes().replace(struct.pack("<I", 200 * 2**20), struct.pack("<I", 2))  # says so, and is not
    path.write_bytes(small)
    with pytest.raises(ScanError, match="cut off or altered"):
        archive.Archive(path)

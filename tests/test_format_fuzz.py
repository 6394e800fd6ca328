"""A slice of the damaged files that tests/fuzz/fuzz_formats.py makes by the hundred thousand, and its watch itself."""

import os
import time

import pytest
import torch

from fuzz import fuzz_formats
from fuzz.fuzz_formats import WELL, fuzz, outcomes
from lidargrit.core.errors import ScanError
from lidargrit.data.formats import ScanFormat
from lidargrit.scans.types import Scan


def test_damaged_files_are_a_scan_or_one_line():
    table = fuzz(1500)
    assert len(table) >= 6
    for name, counts in table.items():
        assert set(counts) <= set(WELL), (name, counts)
        assert counts["scan"] > 0, "some damages leave a scan"
        assert counts["refused"] > counts["scan"] / 2, name


def hide_a_memory_error():
    try:
        bytearray(1 << 40)
    except MemoryError:
        raise ScanError("fine.bin", "less", "buy more memory") from None


class TwoLinesError(ScanError):
    """A refusal that does not escape what it repeats, as every message of ours does."""

    def __str__(self):
        return "got two\nlines of fine; wanted one; shorten it"


def say_two_lines():
    raise TwoLinesError("", "", "")


FAULTS = {
    "hung": lambda: time.sleep(60),
    "killed its process": os.abort,
    "took too much memory": hide_a_memory_error,
    "raised KeyError: \"'x'\"": lambda: {}["x"],
    "no line: 'got two\\nlines of fine; wanted one; shorten it'": say_two_lines,
}


@pytest.mark.parametrize("fault", FAULTS)
def test_the_watch_sees_every_fault_and_goes_on(monkeypatch, tmp_path, fault):
    class Faulty(ScanFormat):
        title, suffixes, reflectance = "faulty", (".bin",), "none"

        @staticmethod
        def recognises(path):
            return True

        @staticmethod
        def read(path, index=0, bad_points="refuse"):
            if path.read_bytes() == b"2":
                FAULTS[fault]()
            return Scan(torch.ones(1, 3))

    inputs = iter(range(10))
    monkeypatch.setattr(fuzz_formats, "SECONDS_AT_MOST", 0.5)
    monkeypatch.setattr(fuzz_formats, "load", lambda name: Faulty)
    monkeypatch.setattr(fuzz_formats, "read_scan", lambda path, bad_points: Faulty.read(path))
    monkeypatch.setattr(fuzz_formats, "one_input", lambda rng, name, files: ("fine.bin", b"%d" % next(inputs)))
    files = [("faulty", "fine.bin", b"good")]
    assert list(outcomes("faulty", range(3), 0, files, tmp_path)) == ["scan", "scan", fault]

"""The order of files by their names: that of time, whichever way the names write it."""

from pathlib import Path

import pytest

from lidargrit.determinism import natural_order

SECONDS = 1_305_031_453


def sorted_names(names: list[str], folder: str = "drive") -> list[str]:
    return [path.name for path in natural_order(Path(folder, name) for name in reversed(names))]


@pytest.mark.parametrize(
    "names",
    [
        [f"{SECONDS}.{part}" for part in ("359684", "36", "4", "40968", "45123", "5")],  # shortened decimals
        ["17.04", "17.1", "17.5", "18.02"],
        ["scan_9.5", "scan_9.75", "scan_10.25"],
        [f"{SECONDS}.{part}" for part in ("5000000", "90000000", "100000000")],  # nanoseconds, not padded
        [f"{SECONDS}.{part}" for part in ("84123457", "123456789")],
        [f"{SECONDS}.{part:06d}" for part in (5, 40, 300, 999_999)],
        [f"1.{part}" for part in range(1, 25)],  # two counters
        ["1.9", "1.11"],
        ["1.2.9", "1.2.10", "1.10.1"],
        ["9", "010", "10", "11.5"],
    ],
)
def test_names_are_in_order_of_time(names):
    assert sorted_names([f"{name}.bin" for name in names]) == [f"{name}.bin" for name in names]


def test_folders_named_by_seconds_are_in_order_of_time():
    paths = [Path("drive", second, "0.bin") for second in ("17.04", "17.1", "18.02")]
    assert natural_order(reversed(paths)) == paths


def test_each_folder_tells_how_its_names_count():
    seconds = [Path("a", f"{name}.bin") for name in ("17.04", "17.1")]
    counters = [Path("b", f"{name}.bin") for name in ("17.1", "17.4", "17.10")]
    assert natural_order([*counters, *seconds]) == [*seconds, *counters]

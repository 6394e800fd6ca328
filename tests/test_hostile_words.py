"""Names of files that the C locale cannot show, or that no file can have: one line in ASCII, whatever the name."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tiny_runs import the_one_line


def lidargrit(words: list[str | bytes], folder: Path) -> tuple[int, str]:
    """Run a command in a folder under the C locale, without Python's UTF-8 mode; return its exit code and stderr."""
    plain = {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}
    command = [sys.executable, "-m", "lidargrit", *words]
    done = subprocess.run(
        command, cwd=folder, env={**os.environ, **plain}, capture_output=True, timeout=120, check=False
    )
    return done.returncode, done.stderr.decode("ascii")  # a terminal of that locale shows nothing else


@pytest.mark.parametrize(
    "name",
    ["straße.bin".encode(), "走.json".encode(), b"\xff.bin", b"x" * 300],
    ids=["German", "Chinese", "no UTF-8", "long"],
)
def test_names_of_missing_files_under_the_c_locale(name, tmp_path):
    code, told = lidargrit(["inspect", name], tmp_path)
    assert code == 2
    the_one_line(told, "inspect")

"""Names of files that some locales cannot show, or that no file can have: used, or refused in one line in ASCII."""

import json
import os
import subprocess
import sys
from pathlib import Path

from lidargrit.data.datasets import load
from tiny_runs import the_one_line

ASCII = {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}


def python(words: list[str | bytes], folder: Path, environment: dict[str, str]) -> tuple[int, str]:
    """Run Python in a folder; return its exit code and stderr."""
    environment = {**os.environ, **environment}
    done = subprocess.run(
        [sys.executable, *words], cwd=folder, env=environment, capture_output=True, timeout=120, check=False
    )
    told = done.stderr.decode("utf-8").splitlines(keepends=True)
    return done.returncode, "".join(line for line in told if not line.endswith(("libraries\n", "ago\n")))


EACH = """
import sys
from lidargrit.cli import main
sys.exit({main(["inspect", name]) for name in sys.argv[1:]} != {2})
"""


def test_names_of_missing_files_under_the_c_locale(tmp_path):
    """German, Chinese, no UTF-8, and too long."""
    names = ["straße.bin".encode(), "走.json".encode(), b"\xff.bin", b"x" * 300]
    code, output = python(["-c", EACH, *names], tmp_path, ASCII)
    assert code == 0
    lines = output.splitlines()
    assert len(lines) == len(names)
    for line in lines:
        the_one_line(line, "inspect")


SEVERAL = """
import sys
from lidargrit.cli import main
for words in sys.argv[1].split(", "):
    if main([*words.split()[:1], sys.argv[2], *words.split()[1:]]):
        sys.exit(words)
"""


def test_files_with_such_names_are_used_under_the_c_locale_or_told_in_one_line(tmp_path):
    load("folder").write_example(tmp_path / "scans", 1)
    (tmp_path / "scans" / "000000.bin").rename(tmp_path / "scans" / "straße.bin")
    (tmp_path / "scans").rename(tmp_path / "走")
    words = ["-c", SEVERAL, "inspect -o scan.png, view -o page.html -n 1, export out --format pcd", "走".encode()]
    cache = {"LIDARGRIT_CACHE": str(tmp_path / "cache")}
    code, output = python(words, tmp_path, cache | ASCII)
    assert code == 1
    assert "in a locale without such letters; wanted a locale of UTF-8; set PYTHONUTF8=1" in output
    the_one_line("\n".join(output.splitlines()[:-1]), "inspect")
    code, output = python(words, tmp_path, cache | {"LC_ALL": "C"})
    assert code == 0, output
    assert (tmp_path / "out" / "straße.pcd").is_file()
    assert "straße" in json.loads((tmp_path / "out" / "export.json").read_text(encoding="utf-8"))["scans"].values()
    assert (tmp_path / "page.html").is_file()
    code, output = python(
        ["-m", "lidargrit", "inspect", "走".encode()], tmp_path, cache | {"PYTHONIOENCODING": "ascii"}
    )
    assert code == 0, output

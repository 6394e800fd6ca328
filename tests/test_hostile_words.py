"""Names of files that some locales cannot show, or that no file can have: used, or refused in one line in ASCII."""

import json
import os
import subprocess
import sys
from pathlib import Path

from dataset_examples import write_example
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


REFUSED_THEN_USED = """
import sys
from lidargrit.cli import main
folder, used, *missing = sys.argv[1:]
if any(main(["inspect", name]) != 2 for name in missing):
    sys.exit("one of the missing files was not refused")
for words in used.split(", "):
    verb, *more = words.split()
    sys.argv = ["lidargrit", verb, folder, *more]  # a program prints what the encoding of its output lacks, too
    if main():
        sys.exit(words)
"""
MISSING = ["straße.bin".encode(), "走.json".encode(), b"\xff.bin", b"x" * 300]  # the third no UTF-8, the last too long


def test_files_with_such_names_are_used_under_the_c_locale_or_told_in_one_line(tmp_path):
    """German and Chinese: a scan and its folder, and files that are missing."""
    write_example("folder", tmp_path / "scans", 1)
    (tmp_path / "scans" / "000000.bin").rename(tmp_path / "scans" / "straße.bin")
    (tmp_path / "scans").rename(tmp_path / "走")
    words = ["-c", REFUSED_THEN_USED, "走".encode()]
    cache = {"LIDARGRIT_CACHE": str(tmp_path / "cache")}
    code, output = python([*words, "inspect", *MISSING], tmp_path, cache | ASCII)
    assert code == 1
    *lines, last = output.splitlines()
    assert last == "inspect"
    assert len(lines) == len(MISSING) + 1
    for line in lines:
        the_one_line(line, "inspect")
    assert "in a locale without such letters; wanted a locale of UTF-8; set PYTHONUTF8=1" in lines[-1]
    used = "inspect -o scan.png, view -o page.html -n 1, export out --format pcd"
    code, output = python([*words, used], tmp_path, cache | {"LC_ALL": "C", "PYTHONIOENCODING": "ascii"})
    assert code == 0, output
    assert (tmp_path / "out" / "straße.pcd").is_file()
    assert "straße" in json.loads((tmp_path / "out" / "export.json").read_text(encoding="utf-8"))["scans"].values()
    assert (tmp_path / "page.html").is_file()

"""A wheel of this checkout, in an environment that has nothing else → what it holds, and whether it runs.

    python tests/package/try_wheel.py

Prints sizes and seconds, and ends with 1 and a reason if a file is missing or a command fails. The packages come from
where pip finds them; torch alone is most of the time.
"""

import os
import subprocess
import sys
import tempfile
import time
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
COMMANDS = (
    ("--version",),
    ("doctor",),
    ("list", "protocols", "--json"),
    ("simulate", "streets", "-n", "2", "--workers", "1"),
    ("inspect", "streets"),
    ("view", "streets", "-n", "1", "-o", "page.html"),
    ("train", "lidargrit_demo", "run", "--dry-run"),
    ("sample", "pretrained", "samples", "-n", "2"),
    ("view", "samples", "-o", "samples.html"),
)


def main() -> int:
    """Build, look, install and run."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        wheel = built(folder)
        if lacking := missing(wheel):
            print(f"the wheel lacks {', '.join(lacking)}", file=sys.stderr)
            return 1
        python = installed(folder / "environment", wheel)
        return tried(python, folder / "work")


def built(folder: Path) -> Path:
    """Build the wheel, and return it."""
    run(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder), str(ROOT))
    (wheel,) = folder.glob("*.whl")
    print(f"{wheel.name}: {wheel.stat().st_size / 1e6:.2f} MB")
    return wheel


def missing(wheel: Path) -> list[str]:
    """Return the files of the package, as git knows them, that the wheel does not have."""
    listed = subprocess.run(["git", "ls-files", "src"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    with zipfile.ZipFile(wheel) as opened:
        there = set(opened.namelist())
    wanted = [path.removeprefix("src/") for path in listed.splitlines()]
    data = [path for path in wanted if not path.endswith(".py")]
    print(f"{len(wanted)} files, {len(data)} of them no Python: {', '.join(Path(path).name for path in data)}")
    return [path for path in wanted if path not in there]


def installed(environment: Path, wheel: Path) -> Path:
    """Install the wheel and what it needs into a new environment, and return its Python."""
    begun = time.monotonic()
    run(sys.executable, "-m", "venv", str(environment))
    python = environment / "bin" / "python"
    before = size_of(environment)
    constraints = ("-c", str(ROOT / "constraints.txt"))
    run(str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *constraints, str(wheel))
    print(f"installed in {time.monotonic() - begun:.0f} s: {(size_of(environment) - before) / 1e6:,.0f} MB")
    return python


def tried(python: Path, work: Path) -> int:
    """Run every command where the checkout is not to be seen, and return 1 if one fails."""
    work.mkdir()
    clean = {name: value for name, value in os.environ.items() if name not in {"PYTHONPATH", "LIDARGRIT_SHARED"}}
    clean["LIDARGRIT_CACHE"] = str(work / "cache")
    for words in COMMANDS:
        begun = time.monotonic()
        command = [str(python.parent / "lidargrit"), *words]
        done = subprocess.run(command, cwd=work, env=clean, capture_output=True, text=True, check=False)
        print(f"lidargrit {' '.join(words)}: {done.returncode} after {time.monotonic() - begun:.1f} s")
        if done.returncode:
            print(done.stderr, file=sys.stderr)
            return 1
    return 0 if (work / "page.html").stat().st_size > 100_000 else 1


def size_of(folder: Path) -> int:
    """Return the bytes of all files below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and not path.is_symlink())


def run(*command: str) -> None:
    """Run a command that must go well."""
    subprocess.run(command, check=True)


if __name__ == "__main__":
    sys.exit(main())

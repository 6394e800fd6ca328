"""Seconds of a command on an idle machine and beside busy processes, by how its threads wait and memory is kept.

    python benchmarks/neighbours.py [--words "sample pretrained {out} -n {n}"] [-n 8 32] [--busy 0 1 2] [--repeats 2]
    python benchmarks/neighbours.py --words "train lidargrit_demo {out} --set training.tokenizer.scans={n}" -n 200
    python benchmarks/neighbours.py --words "demo --out {out}" -n 1 --limit 3000

Each row is one way of waiting: as the command arranges it, as OpenMP does by itself (threads spin), and with one
thread; or of keeping memory: as malloc does by itself, which any of its variables means. A busy process is a Python
loop that never ends. Seconds are of the whole command, its start included, the least of the repeats; beside them how
many processors others took during it, which should be the busy processes alone.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager, suppress
from pathlib import Path

WAYS = {  # name → environment variables; the command leaves what is set already as it is
    "as the command arranges it": {},
    "as OpenMP does by itself": {"GOMP_SPINCOUNT": "300000"},
    "one thread": {"OMP_NUM_THREADS": "1"},
    "as malloc does by itself": {"MALLOC_ARENA_MAX": "64"},
}


@contextmanager
def busy(count: int):
    """Keep so many processors busy meanwhile."""
    neighbours = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for neighbour in neighbours:
            neighbour.kill()
            neighbour.wait()


def busy_jiffies() -> int:
    """Return how long all processors have worked since the machine started, in hundredths of a second."""
    fields = [int(field) for field in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]]
    return sum(fields) - fields[3] - fields[4]


def timed(python: str, words: list[str], environment: dict[str, str], limit_s: float) -> tuple[float, float, float]:
    """Return the seconds of a command, at most the limit, those of its processors, and the processors others took."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("OMP_", "GOMP_", "MALLOC_"))}
    begun, before, used = time.monotonic(), busy_jiffies(), os.times()
    with suppress(subprocess.TimeoutExpired):
        subprocess.run(
            [python, "-m", "lidargrit", *words],
            env=kept | environment,
            check=True,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            timeout=limit_s,
        )
    seconds, after = time.monotonic() - begun, os.times()
    own = after.children_user + after.children_system - used.children_user - used.children_system
    return seconds, own, ((busy_jiffies() - before) / 100 - own) / seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words = "a command, with {out} for a new folder and {n} for the number of scans"
    parser.add_argument("--words", default="sample pretrained {out} -n {n}", help=words)
    parser.add_argument("-n", type=int, nargs="*", default=[8, 32], help="numbers of scans")
    parser.add_argument("--busy", type=int, nargs="*", default=[0, 1, 2], help="how many busy processes")
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--ways", nargs="*", default=list(WAYS), choices=list(WAYS))
    parser.add_argument(
        "--python", default=sys.executable, help="of an environment with another version of the program"
    )
    parser.add_argument("--limit", type=float, default=300, help="seconds after which a command is ended")
    options = parser.parse_args()
    for count in options.n:
        for neighbours in options.busy:
            for name in options.ways:
                found = []
                for _ in range(options.repeats):
                    with tempfile.TemporaryDirectory() as folder, busy(neighbours):
                        words = options.words.format(out=f"{folder}/out", n=count).split()
                        found.append(timed(options.python, words, WAYS[name], options.limit))
                seconds, own, others = min(found)
                bound = ">" if seconds >= options.limit else " "
                print(
                    f"-n {count:<4}{neighbours} busy  {name:<28}{bound}{seconds:7.1f} s  {own:8.1f} s of processors, "
                    f"others took {others:.2f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()

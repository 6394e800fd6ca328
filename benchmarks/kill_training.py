"""Training killed again and again, at random moments and in mid-save: does it end with the weights of a quiet run?

    python benchmarks/kill_training.py
    python benchmarks/kill_training.py --random 40 --in-save 10

A tiny run of two stages is killed (SIGKILL) at random moments, and while a checkpoint is half written, that is when a
partial file is seen in the hidden folder beside a checkpoint. Each time the same command resumes the run. At the end,
its weights and the entries of its logs are compared with those of a run that was never killed.
"""

import argparse
import hashlib
import json
import os
import random
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

from lidargrit.core.files import read_tensors

STAGES = ("tokenizer", "transformer")
SETTINGS = [  # 24 and 48 steps, a checkpoint after each
    "data.train=[simulated:4:train]",
    "data.val=[simulated:1:val]",
    "data.columns=512",
    "data.column_stride=8",
    "model.tokenizer.channel_multipliers=[1,1,1,1]",
    "model.tokenizer.code_dim=8",
    "model.tokenizer.num_codes=32",
    "model.tokenizer.dropout=0.2",
    "model.transformer.layers=1",
    "model.transformer.heads=2",
    "model.transformer.width=16",
    *[
        f"training.{stage}.{setting}"
        for stage in STAGES
        for setting in ("batch_size=4", "checkpoint_every=4", "validate_every=32")
    ],
    "training.tokenizer.scans=96",
    "training.transformer.scans=192",
]
# Modules are imported once, and each try is a fork of that process: the kills meet training, not imports.
SERVER = """
import os, sys
import lightning_fabric, safetensors.torch
import lidargrit.cli, lidargrit.systems.lidargrit.system, lidargrit.generation.presets, lidargrit.training
print("ready", flush=True)
for _ in sys.stdin:
    child = os.fork()
    if not child:
        sys.stderr = open(os.devnull, "w")
        sys.stdout = open(os.devnull, "w")
        os._exit(lidargrit.cli.main(sys.argv[1:]))
    print(child, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


class Runs:
    """Starts the same command as often as asked."""

    def __init__(self, folder: Path) -> None:
        words = ["train", "lidargrit_demo", str(folder), "--set", *SETTINGS]
        self.folder, self.command = folder, shlex.join(["lidargrit", *words])
        self._server = subprocess.Popen(
            [sys.executable, "-P", "-c", SERVER, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert self._read() == "ready"

    def start(self) -> int:
        assert self._server.stdin is not None
        self._server.stdin.write("go\n")
        self._server.stdin.flush()
        return int(self._read())

    def wait(self) -> int:
        return int(self._read())

    def _read(self) -> str:
        assert self._server.stdout is not None
        return self._server.stdout.readline().strip()

    def scans_seen(self) -> int:
        found = [self.folder / stage / "checkpoint.safetensors" for stage in STAGES]
        return sum(read_tensors(path)[1]["scans_seen"] for path in found if path.exists())

    def half_written(self) -> set[Path]:
        return set(self.folder.glob("*/.lidargrit-partial-*/*.partial"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--random", type=int, default=20, help="kills at random moments")
    parser.add_argument("--in-save", type=int, default=6, help="kills while a checkpoint is half written")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng = random.Random(options.seed)
    with tempfile.TemporaryDirectory() as folder:
        os.environ["LIDARGRIT_CACHE"] = str(Path(folder) / "cache")
        whole = Runs(Path(folder) / "whole")
        wait_for(Runs(Path(folder) / "first"), STAGES[0])  # the scans are in the cache from here on
        begun = time.monotonic()
        whole.start()
        assert whole.wait() == 0
        whole_s = time.monotonic() - begun
        stage_s = {stage: logs(whole.folder / stage)[-1]["seconds"] for stage in STAGES}
        start_s = whole_s - sum(stage_s.values())
        print(f"a run that is not killed: {whole_s:.1f} s, {start_s:.1f} s of it to start")
        runs = Runs(Path(folder) / "killed")
        met: Counter[str] = Counter()
        for stage in STAGES:
            if stage != STAGES[0]:
                wait_for(runs, stage)
            kinds = ["random"] * (options.random // 2) + ["in mid-save"] * (options.in_save // 2)
            rng.shuffle(kinds)
            for kind in kinds:
                # So early that it may meet the start, and so late that the stage comes forward.
                met[kill(runs, kind, rng.uniform(start_s / 2, start_s + 1.5 * stage_s[stage] / len(kinds)))] += 1
        left = len(runs.half_written())
        runs.start()
        assert runs.wait() == 0
        for what, count in sorted(met.items()):
            print(f"{count:4d} {what}")
        print(f"{left} half-written checkpoints were left behind by kills")
        same_weights = digest(whole.folder) == digest(runs.folder)
        same_logs = timeless(whole.folder) == timeless(runs.folder)
        print(f"weights the same bit for bit: {same_weights}; logs the same but for the time: {same_logs}")
        sys.exit(0 if same_weights and same_logs else 1)


def wait_for(runs: Runs, stage: str) -> None:
    """Let the run come to a stage, and kill it there."""
    if not (runs.folder / stage).exists():
        child = runs.start()
        while not (runs.folder / stage).exists():
            time.sleep(0.001)
        os.kill(child, signal.SIGKILL)
        runs.wait()


def kill(runs: Runs, kind: str, after_s: float) -> str:
    """Start, kill, and say what the kill met."""
    before, seen, begun = runs.half_written(), runs.scans_seen(), time.monotonic()
    child = runs.start()
    if kind == "random":
        time.sleep(after_s)
    else:
        while not runs.half_written() - before and time.monotonic() - begun < 60 and not over(runs):
            pass  # a save takes milliseconds
    with suppress(ProcessLookupError):  # the run was over
        os.kill(child, signal.SIGKILL)
    status = runs.wait()
    if status == 0:
        return f"{kind}: came too late, the run was over"
    assert status == -signal.SIGKILL, f"a try ended by itself with {status}; the same command tells why: {runs.command}"
    stage = "second stage" if (runs.folder / STAGES[1]).exists() else "first stage"
    if runs.half_written() - before:
        return f"{kind}: {stage}, a checkpoint half written"
    return f"{kind}: {stage}, {'after new checkpoints' if runs.scans_seen() > seen else 'before a new checkpoint'}"


def over(runs: Runs) -> bool:
    return (runs.folder / "config.json").exists()


def digest(folder: Path) -> str:
    return hashlib.sha256((folder / "model.safetensors").read_bytes()).hexdigest()


def logs(stage: Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in (stage / "log.jsonl").read_text().splitlines()]


def timeless(folder: Path) -> list[dict[str, float]]:
    return [{**line, "seconds": 0} for stage in STAGES for line in logs(folder / stage)]


if __name__ == "__main__":
    main()

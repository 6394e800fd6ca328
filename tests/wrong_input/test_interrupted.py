"""Interruptions, full disks and kills: the same command goes on, and ends as if nothing had happened."""

import json
import os
import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest

from lidargrit.cli import main
from lidargrit.core import reporting
from lidargrit.core.files import read_tensors
from lidargrit.data.sources.samples import read_samples
from tiny_runs import LONG, contents, the_one_line, train_words


class Interrupted(reporting.TerminalReporter):
    """Presses Ctrl-C after some steps of training, or terminates."""

    steps, terminates = 0, False

    @contextmanager
    def progress(self, what: str, total: int, done: int = 0) -> Iterator[reporting.Progress]:
        left = iter(range(self.steps - 1)) if what.startswith("training") else iter(range(1 << 30))
        terminates = self.terminates

        class Stopped(reporting.Progress):
            def advance(self, amount: int, note: str = "") -> None:
                if next(left, None) is None:
                    if not terminates:
                        raise KeyboardInterrupt
                    signal.raise_signal(signal.SIGTERM)

        yield Stopped()


@pytest.fixture
def interrupt(monkeypatch):
    """Return a function that runs a command and interrupts it at a step of its training."""

    def run(steps: int, words: list[str], terminates: bool = False) -> int:
        with monkeypatch.context() as patch:
            patch.setattr(Interrupted, "steps", steps)
            patch.setattr(Interrupted, "terminates", terminates)
            patch.setattr(reporting, "TerminalReporter", Interrupted)
            return main(words)

    return run


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory) -> bytes:
    """Return the weights of a run that nothing happened to."""
    folder = tmp_path_factory.mktemp("uninterrupted") / "run"
    assert main(train_words(folder, *LONG)) == 0
    return (folder / "model.safetensors").read_bytes()


@pytest.mark.parametrize(
    ("words", "follows"),
    [
        (["compare", "out", "marginal"], "the same command goes on"),
        (["evaluate", "one", "other"], "the same command begins anew"),
        (["complete", "scans", "out"], "the same command goes on"),
        (["compress", "scans", "out.lgz"], "the same command goes on"),
    ],
)
def test_only_verbs_that_keep_their_work_say_that_they_go_on(words, follows, monkeypatch, capsys):
    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(f"lidargrit.cli.{words[0].replace('-', '_')}.run", interrupted)
    assert main(words) == 130
    assert capsys.readouterr().err == f"\nlidargrit {words[0]}: interrupted; {follows}\n"


def test_an_interrupted_report_says_what_the_scores_that_are_there_take(tmp_path, monkeypatch, capsys):
    """The same command without --overwrite is refused."""
    scores = tmp_path / "scores.json"

    def interrupted(_):
        scores.write_text("{}")
        raise KeyboardInterrupt

    monkeypatch.setattr("lidargrit.cli.evaluate.run", interrupted)
    words = ["evaluate", "one", "other", "--json", str(scores), "--report", str(tmp_path / "page.html")]
    for more, follows in (
        ([], f"{scores} is there, and the same command with --overwrite begins anew"),
        (["--overwrite"], "the same command begins anew"),
    ):
        assert main([*words, *more]) == 130
        assert capsys.readouterr().err == f"\nlidargrit evaluate: interrupted; {follows}\n"


def test_a_file_that_was_finished_when_the_interrupt_came_is_told(tmp_path, monkeypatch, capsys):
    """The same command is refused, for the file is there."""
    file = tmp_path / "scans.lgz"

    def interrupted(_):
        file.write_bytes(b"")
        raise KeyboardInterrupt

    monkeypatch.setattr("lidargrit.cli.compress.run", interrupted)
    assert main(["compress", "scans", str(file)]) == 130
    assert capsys.readouterr().err == (
        f"\nlidargrit compress: interrupted; {file} is there, and the same command with --overwrite begins anew\n"
    )


def hidden(folder: Path) -> list[Path]:
    return [path for path in folder.rglob(".*") if path.is_file()]


def test_interrupted_runs_say_so_and_go_on_to_the_same_weights(interrupt, uninterrupted, tmp_path, capsys):
    words = train_words(tmp_path / "run", *LONG)
    for steps in (1, 4, 4):  # the last in the second stage
        assert interrupt(steps, words) == 130
        lines = capsys.readouterr().err.strip().splitlines()
        assert lines[-1] == "lidargrit train: interrupted; the same command goes on"
        assert "Traceback" not in "".join(lines)
    assert not (tmp_path / "run" / "config.json").exists()
    assert main(["sample", str(tmp_path / "run"), str(tmp_path / "new")]) == 2
    assert "which holds no finished model" in capsys.readouterr().err
    assert main(words) == 0
    assert (tmp_path / "run" / "model.safetensors").read_bytes() == uninterrupted
    assert hidden(tmp_path) == []


def lidargrit(words: list[str], **options) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "lidargrit", *words]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)


@contextmanager
def files_limited_to(size: int) -> Iterator[None]:
    """Let files not grow beyond a size, as on a disk that is full."""
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


def test_a_real_interrupt_from_the_keyboard(interrupt, tmp_path):
    words = train_words(tmp_path / "run", *LONG, "training.tokenizer.scans=1000000")
    heard = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # a shell's background jobs do not hear Ctrl-C
    process = lidargrit(words, preexec_fn=heard)
    checkpoint = tmp_path / "run" / "tokenizer" / "checkpoint.safetensors"
    deadline = time.monotonic() + 60
    while not checkpoint.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, output = process.communicate(timeout=60)
    assert process.returncode == 130, output
    assert output.endswith("\nlidargrit train: interrupted; the same command goes on\n")
    assert "Traceback" not in output
    seen = read_tensors(checkpoint)[1]["scans_seen"]
    assert hidden(tmp_path) == []
    assert interrupt(3, words) == 130
    assert read_tensors(checkpoint)[1]["scans_seen"] == seen + 8, "two more steps, and the third not to its end"


def test_termination_saves_the_step_and_goes_on_to_the_same_weights(interrupt, uninterrupted, tmp_path, capsys):
    """As a batch scheduler does it, here at the second step; no checkpoint is due before the end of the stage."""
    words = train_words(tmp_path / "run", *LONG, "training.tokenizer.checkpoint_every=1000000")
    assert interrupt(2, words, terminates=True) == 143
    output = capsys.readouterr().err
    assert output.endswith("\nlidargrit train: terminated; the same command goes on\n")
    assert "Traceback" not in output
    seen = read_tensors(tmp_path / "run" / "tokenizer" / "checkpoint.safetensors")[1]["scans_seen"]
    assert 8 <= seen < 24
    assert hidden(tmp_path) == []
    assert main(words) == 0
    assert (tmp_path / "run" / "model.safetensors").read_bytes() == uninterrupted


def test_termination_before_the_first_step(tmp_path):
    """While modules are imported the process just ends; from then on it tells how."""
    folder = tmp_path / "run"
    process = lidargrit(train_words(folder, *LONG, "data.train=[simulated:2000:train]"))
    deadline = time.monotonic() + 60
    cache = Path(os.environ["LIDARGRIT_CACHE"])
    before = set(cache.glob("*")) if cache.exists() else set()
    while set(cache.glob("*")) == before and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGTERM)
    _, output = process.communicate(timeout=60)
    assert process.returncode == 143, output
    assert output.endswith("\nlidargrit train: terminated; the same command goes on\n")
    assert not folder.exists()


def test_a_full_disk_during_a_save(interrupt, uninterrupted, tmp_path, capsys):
    words = train_words(tmp_path / "run", *LONG)
    assert interrupt(4, words) == 130
    before = contents(tmp_path)
    capsys.readouterr()
    with files_limited_to(100_000):
        assert main(words) == 2
    line = the_one_line(capsys.readouterr().err, "train")
    assert re.search(r"got '.*' while writing .*checkpoint\.safetensors; .*free some space", line)
    name = "run/tokenizer/checkpoint.safetensors"
    assert contents(tmp_path)[name] == before[name]
    assert hidden(tmp_path) == []
    assert main(words) == 0
    assert (tmp_path / "run" / "model.safetensors").read_bytes() == uninterrupted


def test_a_full_disk_while_sampling(run_folder, samples, tmp_path, capsys):
    before = contents(tmp_path)
    capsys.readouterr()
    with files_limited_to(1000):
        assert main(["sample", str(run_folder), str(samples), "-n", "3"]) == 2
    output = capsys.readouterr().err
    assert re.search(r"got '.*' while writing .*00000002\.npz; .*free some space", the_one_line(output, "sample"))
    assert contents(tmp_path) == before


def test_a_full_disk_before_the_first_step_and_while_projecting(tmp_path, monkeypatch, capsys):
    assert main(train_words(tmp_path / "warm")) == 0  # so that the scans are in the cache
    for size, wanted in ((0, "run.json"), (8_000, "plan.json")):
        capsys.readouterr()
        with monkeypatch.context() as patch, files_limited_to(size):
            if size:
                patch.setenv("LIDARGRIT_CACHE", str(tmp_path / "cache"))
            assert main(train_words(tmp_path / "run")) == 2
        assert re.search(rf"got '.*' while writing .*{wanted}; ", the_one_line(capsys.readouterr().err, "train"))
        assert hidden(tmp_path) == []
    assert main(train_words(tmp_path / "run")) == 0


def test_a_full_disk_where_a_preparation_begins_leaves_nothing(tmp_path, capsys):
    for size, wanted in ((0, "scans.json"), (1000, "plan.json")):
        with files_limited_to(size):
            assert main(["prepare", "simulated:1", "-o", str(tmp_path / "out")]) == 2
        assert re.search(rf"got '.*' while writing .*{wanted}; ", the_one_line(capsys.readouterr().err, "prepare"))
        assert contents(tmp_path) == {}
        assert not (tmp_path / "out").exists()


def test_a_full_disk_while_logging(tmp_path, interrupt, capsys):
    words = train_words(tmp_path / "run", *LONG)
    assert interrupt(4, words) == 130
    log = tmp_path / "run" / "tokenizer" / "log.jsonl"
    log.mkdir()  # stands for anything that keeps the file from being opened
    capsys.readouterr()
    assert main(words) == 2
    assert "log.jsonl" in the_one_line(capsys.readouterr().err, "train")


KILLER = """
import json, os, random, signal, sys, time
import lightning_fabric, safetensors.torch
import lidargrit.cli, lidargrit.inference.samples, lidargrit.systems.lidargrit.system
import lidargrit.generation.presets, lidargrit.training

for longest_s, words in json.loads(sys.argv[1]):
    rng = random.Random(5)
    for _ in range(4):
        child = os.fork()
        if not child:
            os._exit(lidargrit.cli.main(words))
        time.sleep(rng.uniform(0, longest_s))
        os.kill(child, signal.SIGKILL)
        if os.waitpid(child, 0)[1] not in (0, signal.SIGKILL):
            sys.exit("a killed command left something that the next could not go on from")
"""


def test_commands_that_are_killed_again_and_again_end_with_the_same_weights_and_scans(
    uninterrupted, finished, tmp_path
):
    """To the byte. All are forks of one process, so that modules are imported once."""
    words = train_words(tmp_path / "run", *LONG)
    sampling = ["sample", str(finished["run"]), str(tmp_path / "new"), "-n", "20"]
    command = [sys.executable, "-c", KILLER, json.dumps([(1.0, words), (0.4, sampling)])]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert main(words) == 0
    assert (tmp_path / "run" / "model.safetensors").read_bytes() == uninterrupted
    assert hidden(tmp_path / "run" / "tokenizer") == hidden(tmp_path / "run" / "transformer") == []
    for stage in ("tokenizer", "transformer"):
        seen = [
            json.loads(line)["scans_seen"] for line in (tmp_path / "run" / stage / "log.jsonl").read_text().splitlines()
        ]
        assert seen == sorted(set(seen)), "every line once"
    assert main(sampling) == 0
    assert main(["sample", str(finished["run"]), str(tmp_path / "whole"), "-n", "20"]) == 0
    assert contents(tmp_path / "new") == contents(tmp_path / "whole")


def leave_half_written(folder: Path) -> None:
    """Leave what a killed process leaves of a file that it was writing."""
    hidden = folder / f".lidargrit-partial-{os.getuid()}"
    hidden.mkdir(parents=True, exist_ok=True)
    (hidden / "abc12345.partial").write_bytes(b"half")


def test_what_a_killed_process_leaves_half_written_breaks_nothing(refused, run_folder, samples, tmp_path):
    for path in (*samples.iterdir(), *run_folder.rglob("*.*")):
        if path.is_file():
            leave_half_written(path.parent)
    assert len(read_samples(samples)) == 2
    for words in (
        train_words(run_folder),
        ["sample", str(run_folder), str(samples), "-n", "3"],
        ["evaluate", str(samples), "simulated:2:test"],
        ["view", str(samples), str(run_folder), "-o", str(tmp_path / "picture.png"), "-n", "1"],
    ):
        assert main(words) == 0


@pytest.mark.parametrize("name", ["run.json", "samples.json"])
def test_a_process_killed_while_it_wrote_its_very_first_file(run_folder, tmp_path, name):
    folder = tmp_path / "new"
    leave_half_written(folder)
    assert main(train_words(folder) if name == "run.json" else ["sample", str(run_folder), str(folder), "-n", "1"]) == 0

"""What long work says: how much is left of it and of all work, on terminals and in files."""

import io
import os
import sys
import time
from contextlib import suppress
from contextvars import copy_context
from functools import partial
from pathlib import Path
from threading import Thread

import pytest
from rich.console import Console

from lidargrit import cli
from lidargrit.core import reporting
from lidargrit.core.files import read_json
from lidargrit.core.reporting import Schedule, TerminalReporter
from lidargrit.data.drives import DriveConfig, write_drives
from lidargrit.data.run_folder import RUN_FILE
from lidargrit.scans.sensors import load_sensor
from lidargrit.viewer.demo import _INTERRUPTED, _Clock


class Clock:
    seconds = 0.0

    def __call__(self) -> float:
        return self.seconds


def reporter_on(width: int, is_terminal: bool) -> tuple[TerminalReporter, io.StringIO]:
    reporter, text = TerminalReporter(), io.StringIO()
    reporter._console = Console(file=text, width=width, force_terminal=is_terminal, highlight=False)
    return reporter, text


def test_a_schedule_learns_the_pace_and_skips_what_was_done_already():
    clock = Clock()
    schedule = Schedule({"simulate": 50.0, "train": 100.0, "score": 10.0}, clock)
    assert schedule.left_s() == 160.0, "as expected, before anything is known"
    schedule.begin("train", 0.0)  # the scans were there
    assert schedule.left_s() == 110.0
    clock.seconds = 100.0
    schedule.advance("train", 0.5)  # twice as slow as expected
    assert schedule.left_s() == pytest.approx(60 * 110 / 60)
    schedule.advance("train", 1.0)
    schedule.begin("train", 0.0)  # again, as for a second source of scans
    schedule.advance("train", 0.5)
    schedule.begin("another", 0.0)
    schedule.advance("another", 0.5)
    assert schedule.left_s() == pytest.approx(10 * 110 / 110)


def test_files_get_a_line_every_ten_seconds_and_at_every_tenth(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(reporting.time, "monotonic", clock)
    reporter, text = reporter_on(200, is_terminal=False)
    reporter.expect({"training": 100.0, "scoring": 3600.0})
    with reporter.progress("training", 1000) as progress:
        for _ in range(30):
            clock.seconds += 1.0
            progress.advance(1, note="loss 1")
        progress.advance(100)
    lines = text.getvalue().splitlines()
    assert [line.split()[1] for line in lines] == ["10/1000", "20/1000", "30/1000", "130/1000"]
    assert lines[0].startswith("training: 10/1000 1.0/s, 16:30 left, ")
    assert " in all loss 1" in lines[0]


@pytest.mark.parametrize("width", [80, 160])
def test_a_bar_fits_its_terminal(width):
    reporter, text = reporter_on(width, is_terminal=True)
    reporter.expect({"training transformer": 3000.0, "scoring": 30.0})
    with reporter.progress("training transformer", 20_000, 10_000) as progress:
        for _ in range(3):
            progress.advance(8, note="loss 1.2345  0.8 GiB")
    last = [line for line in text.getvalue().splitlines() if "10024/20000" in line][-1]
    assert " left" in last
    assert "…" not in last, "nothing is cut"
    assert ("GiB" in last) == (width > 100)


def test_interrupted_stages_keep_the_time_that_they_took(tmp_path):
    (tmp_path / RUN_FILE).write_text("{}")
    path = tmp_path / "timings.json"
    with pytest.raises(KeyboardInterrupt), _Clock(path).stage("sample"):
        raise KeyboardInterrupt
    assert list(read_json(path)) == ["sample" + _INTERRUPTED]
    path.write_text('{"sample (interrupted)": 41.0}')
    with _Clock(path).stage("sample"):
        pass
    assert read_json(path) == {"sample": 41.0}
    with _Clock(path).stage("sample"):  # the same command again
        pass
    assert read_json(path) == {"sample": 41.0}


def test_silence_is_broken_by_a_line_and_only_silence(monkeypatch, capsys):
    monkeypatch.setattr(reporting, "_SILENT_AT_FIRST_S", 0.1)
    monkeypatch.setattr(reporting, "_SILENT_S_AT_MOST", reporting._MARGIN_S + 1.0)
    reporter, text = reporter_on(100, is_terminal=False)
    with reporter.never_silent("lidargrit train"):
        time.sleep(1.5)
    assert capsys.readouterr().err == "lidargrit train loads its libraries\n"
    lines = text.getvalue().splitlines()
    assert lines[0].startswith("lidargrit train is still at work, begun 0:0")
    assert len(lines) == 1
    time.sleep(0.5)
    assert len(text.getvalue().splitlines()) == 1, "after its end"
    with reporter.never_silent("lidargrit serve", waits=True):
        time.sleep(1.5)
    assert len(text.getvalue().splitlines()) == 1, "of its waiting"
    assert capsys.readouterr().err == "lidargrit serve loads its libraries\n"
    with reporter.never_silent("lidargrit train"):
        for _ in range(20):
            reporter.message("something")
            time.sleep(0.01)
    assert len(text.getvalue().splitlines()) == 21
    assert capsys.readouterr().err == ""


def test_a_command_that_waits_says_that_it_loads(monkeypatch, capsys):
    monkeypatch.setattr(reporting, "_SILENT_AT_FIRST_S", 0.0)
    monkeypatch.setattr(cli, "_keep_freed_memory", lambda: None)
    monkeypatch.delenv("RANK", raising=False)
    assert cli._run(["serve", "nope"], is_program=True) == 2
    first, second = capsys.readouterr().err.splitlines()
    assert first == "lidargrit serve loads its libraries"
    assert second.startswith("lidargrit serve: got nope, which does not exist; ")


def test_a_reader_that_has_gone_ends_no_work(monkeypatch):
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as gone:
        monkeypatch.setattr(sys, "stderr", gone)
        reporter = TerminalReporter()
        with reporter.progress("sampling", 2) as progress:
            for _ in range(2):
                progress.advance(1)
        reporter.of_process("two").message("a line")
        monkeypatch.undo()
        with suppress(BrokenPipeError):
            gone.close()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_a_full_disk_for_messages_ends_no_work(monkeypatch):
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stderr", full)
        TerminalReporter().message("a line")
        monkeypatch.undo()
        with suppress(OSError):
            full.close()


def test_no_standard_error_is_no_error(monkeypatch):
    monkeypatch.setattr(sys, "stderr", None)
    TerminalReporter().message("a line")


def test_only_the_inner_receiver_hears_a_piece_of_work_and_none_after_it(heard):
    reporting.message("a line for the outer")
    with suppress(ZeroDivisionError), reporting.to(reporting.Reporter()):
        reporting.message("a line for nobody")
        raise ZeroDivisionError
    reporting.message("another for the outer")
    assert heard == ["a line for the outer", "another for the outer"]


def test_a_thread_is_silent_unless_it_has_a_copy_of_the_context(heard):
    for work in (reporting.message, partial(copy_context().run, reporting.message)):
        thread = Thread(target=work, args=(f"{type(work).__name__} in a thread",))
        thread.start()
        thread.join()
    assert heard == ["partial in a thread"]


def test_a_command_is_heard_and_a_call_of_the_library_is_not(tmp_path, capsys):
    write_drives(tmp_path / "a", 1, DriveConfig(load_sensor("vlp16")))
    assert capsys.readouterr().err == ""
    assert cli.main(["simulate", str(tmp_path / "b"), "-n", "1", "--sensor", "vlp16"]) == 0
    assert capsys.readouterr().err.startswith("simulating: 1/1")

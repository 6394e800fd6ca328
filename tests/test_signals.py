"""Ctrl-C, SIGTERM and SIGHUP: one line and an exit code, whenever they come."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from lidargrit.cli._signals import raising_on_signals
from lidargrit.core.errors import Terminated

SIGNALS = {signal.SIGTERM: Terminated, signal.SIGHUP: Terminated, signal.SIGINT: KeyboardInterrupt}


@pytest.fixture(autouse=True)
def _heard():
    """Let signals be heard: where the tests run in the background of a shell, some are ignored from the start."""
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGHUP: signal.SIG_DFL}
    befores = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    for number, before in befores.items():
        signal.signal(number, before)


def interrupted(action: Callable[[], object]) -> None:
    """Do something during which a signal comes, and then wait for it."""
    with raising_on_signals():
        action()
        time.sleep(5)
        pytest.fail("the signal was lost")


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_during_an_import_is_raised_after_it(number, tmp_path, monkeypatch):
    name = f"slow_{number.name.lower()}"
    module = f"import os, time\nos.kill(os.getpid(), {int(number)})\ntime.sleep(0.2)\nfinished = True\n"
    (tmp_path / f"{name}.py").write_text(module)
    monkeypatch.syspath_prepend(tmp_path)
    before = signal.getsignal(number), signal.getsignal(signal.SIGALRM)
    with pytest.raises(SIGNALS[number]):
        interrupted(lambda: __import__(name))
    assert sys.modules[name].finished
    assert (signal.getsignal(number), signal.getsignal(signal.SIGALRM)) == before


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_during_the_last_import_is_not_lost(number, tmp_path, monkeypatch):
    name = f"last_{number.name.lower()}"
    (tmp_path / f"{name}.py").write_text(f"import os\nos.kill(os.getpid(), {int(number)})\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(SIGNALS[number]), raising_on_signals():
        __import__(name)
    assert signal.getitimer(signal.ITIMER_REAL) == (0, 0)


@pytest.mark.parametrize("number", SIGNALS)
def test_elsewhere_it_is_raised_at_once(number):
    with pytest.raises(SIGNALS[number]):
        interrupted(lambda: os.kill(os.getpid(), number))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])  # in the background of a script, and under nohup
def test_an_ignored_signal_stays_ignored(number):
    signal.signal(number, signal.SIG_IGN)
    with raising_on_signals():
        os.kill(os.getpid(), number)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_output_that_cannot_be_written_is_one_line():
    with open("/dev/full", "wb") as full:
        words = [sys.executable, "-P", "-m", "lidargrit", "list", "sensors"]
        done = subprocess.run(words, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 2
    told = done.stderr.splitlines()[-1]  # behind what a slow machine is told while libraries load
    assert told.startswith("lidargrit list: got 'No space left on device' while writing the output; wanted")
    assert done.stderr.count("got ") == 1


def test_a_closed_standard_output_is_no_error():
    code = "import sys; sys.stdout = None; from lidargrit.cli import main; sys.exit(main(['list', 'sensors']))"
    done = subprocess.run([sys.executable, "-P", "-c", code], stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")

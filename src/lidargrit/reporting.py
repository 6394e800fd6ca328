"""How long work speaks to a person: nothing by default, a progress bar and messages on a terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class Progress:
    """One piece of long work; this one is silent."""

    def advance(self, amount: int, note: str = "") -> None:
        """Say that ``amount`` more is done, with a short note such as the loss."""


class Reporter:
    """Tells of long work; this one is silent, as a library is."""

    def message(self, text: str) -> None:
        """Say one line."""

    @contextmanager
    def progress(self, what: str, total: int, done: int = 0) -> Iterator[Progress]:
        """Show how far a piece of work is and how long it will still take."""
        yield Progress()

    def of_process(self, name: str) -> Reporter:
        """Return the reporter of one of several processes that work at the same time; its lines begin with a name."""
        return self


class TerminalReporter(Reporter):
    """Speaks on standard error: bars on a terminal, a line now and then in a log file."""

    def __init__(self) -> None:
        from rich.console import Console  # noqa: PLC0415  only the command line needs it

        self._console = Console(file=sys.stderr, highlight=False)

    def message(self, text: str) -> None:
        """Say one line."""
        self._console.print(text, markup=False, soft_wrap=True)

    @contextmanager
    def progress(self, what: str, total: int, done: int = 0) -> Iterator[Progress]:
        """Show a bar with the time left."""
        from rich import progress as bars  # noqa: PLC0415

        columns: list[Any] = [
            bars.TextColumn("{task.description:<22}"),
            bars.BarColumn(),
            bars.MofNCompleteColumn(),
            bars.TextColumn("{task.fields[rate]:>16}"),
            bars.TimeElapsedColumn(),
            bars.TextColumn("left"),
            bars.TimeRemainingColumn(elapsed_when_finished=False),
            bars.TextColumn("{task.fields[note]}"),
        ]
        if not self._console.is_terminal:
            yield _LoggedProgress(self, what, total, done)
            return
        with bars.Progress(*columns, console=self._console, speed_estimate_period=60) as display:
            task = display.add_task(what, total=total, completed=done, note="", rate="")
            yield _Bar(display, task)

    def of_process(self, name: str) -> Reporter:
        """Return a reporter without bars, which would overwrite those of other processes."""
        return _LineReporter(name)


class _LineReporter(Reporter):
    def __init__(self, name: str) -> None:
        self._name = name

    def message(self, text: str) -> None:
        print(f"{self._name}: {text}", file=sys.stderr, flush=True)

    @contextmanager
    def progress(self, what: str, total: int, done: int = 0) -> Iterator[Progress]:
        yield _LoggedProgress(self, what, total, done)


class _Bar(Progress):
    def __init__(self, display: Any, task: Any) -> None:
        self._display, self._task = display, task

    def advance(self, amount: int, note: str = "") -> None:
        speed = self._display.tasks[self._task].speed
        rate = f"{speed:.1f} scans/s" if speed else ""
        self._display.update(self._task, advance=amount, note=note, rate=rate)


class _LoggedProgress(Progress):
    """One line at every tenth of the work, for output that is not a terminal."""

    def __init__(self, reporter: Reporter, what: str, total: int, done: int) -> None:
        from time import monotonic  # noqa: PLC0415

        self._reporter, self._what, self._total, self._done, self._clock = reporter, what, total, done, monotonic
        self._begun, self._begun_at = monotonic(), done

    def advance(self, amount: int, note: str = "") -> None:
        before, self._done = self._done, self._done + amount
        if self._total and before * 10 // self._total == self._done * 10 // self._total:
            return
        speed = (self._done - self._begun_at) / max(self._clock() - self._begun, 1e-9)
        left_s = (self._total - self._done) / max(speed, 1e-9)
        self._reporter.message(
            f"{self._what}: {self._done}/{self._total}, {speed:.1f} scans/s, {left_s:.0f} s left {note}".rstrip()
        )

"""Progress and messages of long work: silent by default, a progress bar on a terminal, lines in a log file.

Whoever works reports by :func:`message` and :func:`progress`; whoever wants to hear it says so by :func:`to`.
"""

import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from contextvars import ContextVar
from functools import cached_property
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

_SILENT_S_AT_MOST = 10.0  # between two lines of one piece of work, where there is no terminal
_SILENT_AT_FIRST_S = 0.7  # while libraries are loaded, which takes some seconds
_MARGIN_S = 1.0  # by which a line about silence comes before it is too long
_PRIOR_S = 10.0  # of expected work that counts as having taken as long as expected, so that first seconds mislead less
_NOTE_COLUMNS = 110  # of a terminal; narrower ones show no note behind the bar
_BAR_COLUMNS = 10, 40  # fewest and most columns of a bar
_WORDS_COLUMNS = 72  # of all but the bar and the note


class Progress:
    """One piece of long work; this one is silent."""

    def advance(self, amount: int, note: str = "") -> None:
        """Report that ``amount`` more is done, with a short note such as the loss."""


class Reporter:
    """Receiver of progress and messages; this one is silent, as a library should be."""

    def message(self, text: str) -> None:
        """Report one line."""

    def expect(self, expected_s: Mapping[str, float]) -> None:
        """Announce all pieces of work to come, so that the time left for all of them can be shown.

        Args:
            expected_s: expected seconds of each piece, by its name in :meth:`progress`, in order.
        """

    @contextmanager
    def progress(self, what: str, total: int, done: int = 0) -> Iterator[Progress]:
        """Show how far a piece of work is and how long it will still take."""
        yield Progress()

    def of_process(self, name: str) -> "Reporter":
        """Return the reporter of one of several processes that work at the same time; its lines begin with a name."""
        return self


_heard_by: ContextVar[Reporter] = ContextVar("reporter", default=Reporter())  # noqa: B039  it has no state


@contextmanager
def to(reporter: Reporter) -> Iterator[None]:
    """Let a receiver have what is reported from here on, in this thread, in tasks of it, and in forks.

    A new thread is silent until it is given a copy of the context (:func:`contextvars.copy_context`).
    """
    token = _heard_by.set(reporter)
    try:
        yield
    finally:
        _heard_by.reset(token)


def current() -> Reporter:
    """Return the receiver of what is reported here; a silent one outside of :func:`to`."""
    return _heard_by.get()


def message(text: str) -> None:
    """Report one line."""
    current().message(text)


def expect(expected_s: Mapping[str, float]) -> None:
    """Announce pieces of work to come with their expected seconds (:meth:`Reporter.expect`)."""
    current().expect(expected_s)


def progress(what: str, total: int, done: int = 0) -> AbstractContextManager[Progress]:
    """Show how far a piece of work is and how long it will still take."""
    return current().progress(what, total, done)


class Schedule:
    """Estimates the time left for several pieces of work in a row.

    The pace of the work so far, its seconds over the expected ones, is taken to be the pace of the rest. A piece that
    never began although a later one has is taken to be done, as where its results were there already.

    Args:
        expected_s: expected seconds of each piece, by its name, in order.
        clock: function that returns seconds.
    """

    def __init__(self, expected_s: Mapping[str, float], clock: Callable[[], float] = time.monotonic) -> None:
        self._expected_s, self._clock = dict(expected_s), clock
        self._left_s = dict(expected_s)  # expected seconds of what is not done yet
        self._worked_s = self._took_s = 0.0  # expected and measured seconds of what was done
        self._at = clock()

    def begin(self, what: str, share: float) -> None:
        """Note that a piece begins, of which a share is done already."""
        if what not in self._expected_s:
            return
        for name in self._expected_s:
            if name == what:
                break
            self._left_s[name] = 0.0
        self._left_s[what] = min(self._left_s[what], (1 - share) * self._expected_s[what])
        self._at = self._clock()

    def advance(self, what: str, share: float) -> None:
        """Note which share of a piece is done by now."""
        if what not in self._expected_s:
            return
        left_s, now = min(self._left_s[what], (1 - share) * self._expected_s[what]), self._clock()
        self._worked_s += self._left_s[what] - left_s
        self._took_s += now - self._at
        self._left_s[what], self._at = left_s, now

    def left_s(self) -> float:
        """Return the seconds that all pieces will still take."""
        return sum(self._left_s.values()) * (self._took_s + _PRIOR_S) / (self._worked_s + _PRIOR_S)


class TerminalReporter(Reporter):
    """Writes to standard error: bars on a terminal, a line every few seconds in a log file."""

    def __init__(self) -> None:
        self._schedule = Schedule({})
        self._said_s = time.monotonic()

    @contextmanager
    def never_silent(self, command: str, waits: bool = False) -> Iterator[None]:
        """Say within the block that work goes on, wherever nothing else is said for ten seconds, or two at first.

        Args:
            waits: whether the command then waits for others, in silence.
        """
        ended, begun_s = threading.Event(), time.monotonic()
        self._said_s = begun_s

        def watch() -> None:
            if not ended.wait(_SILENT_AT_FIRST_S) and self._said_s == begun_s and sys.stderr is not None:
                self._note_said()
                with suppress(OSError):  # not by rich, which has yet to be loaded itself
                    print(f"{command} loads its libraries", file=sys.stderr, flush=True)
            at_most_s = _SILENT_S_AT_MOST - _MARGIN_S
            while not waits and not ended.wait(max(0.0, self._said_s + at_most_s - time.monotonic())):
                if time.monotonic() - self._said_s >= at_most_s:
                    self.message(f"{command} is still at work, begun {_minutes(time.monotonic() - begun_s)} ago")

        thread = threading.Thread(target=watch, daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    @cached_property
    def _console(self) -> "Console":
        from rich.console import Console  # noqa: PLC0415  only a command that reports needs it

        class Silent(Console):
            """A console that falls silent when its reader has gone; rich's own would end the program."""

            def on_broken_pipe(self) -> None:
                self.quiet = True

        return Silent(file=sys.stderr, highlight=False, quiet=sys.stderr is None)

    def message(self, text: str) -> None:
        """Say one line."""
        self._note_said()
        with suppress(OSError):  # a full disk: what is worked on matters more
            self._console.print(text, markup=False, soft_wrap=True)

    def expect(self, expected_s: Mapping[str, float]) -> None:
        """Show from now on how long all pieces of work will still take."""
        self._schedule = Schedule(expected_s)

    @contextmanager
    def progress(self, what: str, total: int, done: int = 0) -> Iterator[Progress]:
        """Show a bar with the time left."""
        self._schedule.begin(what, done / max(total, 1))
        if not self._console.is_terminal:
            yield _LoggedProgress(self.message, self._schedule, what, total, done)
            return
        from rich import progress as bars  # noqa: PLC0415

        low, high = _BAR_COLUMNS
        columns: list[Any] = [
            bars.TextColumn("{task.description}"),
            bars.BarColumn(bar_width=max(low, min(high, self._console.width - _WORDS_COLUMNS))),
            bars.MofNCompleteColumn(),
            bars.TextColumn("{task.fields[words]}"),
        ]
        with bars.Progress(*columns, console=self._console, speed_estimate_period=60) as display:
            task = display.add_task(what, total=total, completed=done, words="")
            yield _Bar(display, task, self._schedule, self._console.width >= _NOTE_COLUMNS, self._note_said)

    def _note_said(self) -> None:
        self._said_s = time.monotonic()

    def of_process(self, name: str) -> Reporter:
        """Return a reporter without bars, which would overwrite those of other processes."""
        return _LineReporter(name)


class _LineReporter(Reporter):
    def __init__(self, name: str) -> None:
        self._name = name

    def message(self, text: str) -> None:
        with suppress(OSError):
            print(f"{self._name}: {text}", file=sys.stderr, flush=True)

    @contextmanager
    def progress(self, what: str, total: int, done: int = 0) -> Iterator[Progress]:
        yield _LoggedProgress(self.message, Schedule({}), what, total, done)


class _Bar(Progress):
    def __init__(
        self, display: Any, task: Any, schedule: Schedule, shows_note: bool, note_said: Callable[[], None]
    ) -> None:
        self._display, self._task, self._schedule, self._shows_note = display, task, schedule, shows_note
        self._note_said = note_said

    def advance(self, amount: int, note: str = "") -> None:
        self._note_said()
        self._display.update(self._task, advance=amount)
        task = self._display.tasks[self._task]
        self._schedule.advance(task.description, task.completed / max(task.total, 1))
        words = _words(task.speed or 0.0, float(task.time_remaining or 0), self._schedule.left_s())
        self._display.update(self._task, words=f"{words} {note}".rstrip() if self._shows_note else words)


class _LoggedProgress(Progress):
    """A line every few seconds, and at every tenth of the work, for output that is not a terminal."""

    def __init__(self, say: Callable[[str], None], schedule: Schedule, what: str, total: int, done: int) -> None:
        self._say, self._schedule, self._what, self._total, self._done = say, schedule, what, total, done
        self._begun_s = self._said_s = time.monotonic()
        self._begun_at = done

    def advance(self, amount: int, note: str = "") -> None:
        before, self._done = self._done, self._done + amount
        self._schedule.advance(self._what, self._done / max(self._total, 1))
        now_s, tenth = time.monotonic(), max(self._total, 1) / 10
        if before // tenth == self._done // tenth and now_s - self._said_s < _SILENT_S_AT_MOST:
            return
        self._said_s = now_s
        speed = (self._done - self._begun_at) / max(now_s - self._begun_s, 1e-9)
        left_s = (self._total - self._done) / speed if speed else 0.0
        words = _words(speed, left_s, self._schedule.left_s())
        self._say(f"{self._what}: {self._done}/{self._total} {words} {note}".rstrip())


def _words(speed: float, left_s: float, all_left_s: float) -> str:
    """Return speed and time left in words: ``1.2/s, 8:01 left, 12:30 in all``."""
    in_all = [f"{_minutes(all_left_s)} in all"] if all_left_s > left_s else []
    return ", ".join([f"{speed:.1f}/s", f"{_minutes(left_s)} left", *in_all] if speed else in_all)


def _minutes(seconds: float) -> str:
    whole = round(min(seconds, 1e7))
    hours, rest = divmod(whole, 3600)
    return f"{hours}:{rest // 60:02d}:{rest % 60:02d}" if hours else f"{rest // 60}:{rest % 60:02d}"

"""Ctrl-C, SIGTERM and SIGHUP → KeyboardInterrupt and Terminated, never in the middle of an import."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

from lidargrit.core.errors import Terminated

_IMPORTING = "<frozen importlib._bootstrap>"
_AGAIN_S = 0.05


@contextmanager
def raising_on_signals() -> Iterator[None]:
    """Let SIGTERM, which batch schedulers send before they kill, end a verb as Ctrl-C does: with its files in order.

    So does SIGHUP, which a terminal that closes and a connection that breaks send, unless it is ignored, as by nohup.

    A module that an exception leaves half imported fails later, with an error that hides the signal. So a signal that
    comes during an import is raised as soon as the import is done, or else at the end of the ``with`` block.
    """
    raised: dict[int, type[BaseException]] = {signal.SIGTERM: Terminated}
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # ignored in the background of a script
        raised[signal.SIGINT] = KeyboardInterrupt
    if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:
        raised[signal.SIGHUP] = Terminated
    befores: dict[int, Any] = {}
    waiting: list[int] = []  # came during an import

    def receive(number: int, frame: FrameType | None) -> None:
        if number in raised:
            waiting.append(number)
        if waiting and _is_importing(frame):
            if signal.SIGALRM not in befores:
                befores[signal.SIGALRM] = signal.signal(signal.SIGALRM, receive)
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)
        elif waiting:
            first = waiting[0]
            waiting.clear()
            raise raised[first]

    with suppress(ValueError):  # a caller's thread: signals are the caller's
        befores.update({number: signal.signal(number, receive) for number in raised})
    try:
        yield
    finally:
        if signal.SIGALRM in befores:
            signal.setitimer(signal.ITIMER_REAL, 0)
        for number, before in befores.items():
            signal.signal(number, before)
        if waiting:
            raise raised[waiting[0]]


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename == _IMPORTING:
            return True
        frame = frame.f_back
    return False

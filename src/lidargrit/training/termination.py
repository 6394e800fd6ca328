"""SIGTERM, or the end of the time that is given → a flag, so that the step in progress is finished and saved."""

import math
import signal
import time
from types import FrameType


class Termination:
    """Within its ``with`` block, a SIGTERM makes ``asked`` true and does not end the process.

    Batch schedulers send this signal some seconds before they kill. Python lets only the main thread handle signals;
    in other threads the block changes nothing.

    Args:
        deadline_s: value of ``time.monotonic()`` from which on ``asked`` is true without a signal.
    """

    def __init__(self, deadline_s: float = math.inf) -> None:
        self._signalled, self._deadline_s = False, deadline_s

    @property
    def asked(self) -> bool:
        """Whether training is to stop after the step in progress."""
        return self._signalled or time.monotonic() >= self._deadline_s

    def __enter__(self) -> "Termination":
        try:
            self._before = signal.signal(signal.SIGTERM, self._note)
        except ValueError:  # not the main thread
            self._before = None
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            signal.signal(signal.SIGTERM, self._before)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self._signalled = True

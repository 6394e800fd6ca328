"""SIGTERM → a flag, so that the step in progress is finished and saved before the process ends."""

from __future__ import annotations

import signal
from types import FrameType


class Termination:
    """Within its ``with`` block, a SIGTERM sets ``asked`` and does not end the process.

    Batch schedulers send this signal some seconds before they kill. Python lets only the main thread handle signals;
    in other threads the block changes nothing.
    """

    def __init__(self) -> None:
        self.asked = False

    def __enter__(self) -> Termination:
        try:
            self._before = signal.signal(signal.SIGTERM, self._note)
        except ValueError:  # not the main thread
            self._before = None
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            signal.signal(signal.SIGTERM, self._before)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.asked = True

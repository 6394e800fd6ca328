"""SIGTERM → a flag, so that a step in progress is finished and saved before the process ends."""

from __future__ import annotations

import signal
from types import FrameType


class Termination:
    """Notes a SIGTERM, which batch schedulers send some seconds before they kill, while it is entered.

    Outside of the main thread nothing can be noted, and the signal does what it did.
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

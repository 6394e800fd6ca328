"""What a stranger can ask for at most: numbers with their reasons, in one place."""

from __future__ import annotations

from dataclasses import dataclass

from lidargrit.errors import ConfigError


@dataclass(frozen=True)
class Limits:
    """Bounds on size, time and number.

    Args:
        upload_bytes: of a file; a revolution of 128 rows by 2048 columns takes 12.6 MB as Ouster's PCD.
        request_bytes: of a question in words.
        scans: drawn at once.
        seconds: that drawing may take; then it is ended, whatever it was doing.
        start_seconds: that reading the runs may take.
        waiting: who may wait for others; whoever comes after is told to come again.
        unpolled_seconds: whoever waits and does not ask for so long is gone, and is not drawn for.
        kept: results; the oldest are forgotten first.
        connections: at once, open and quiet ones included.
        idle_seconds: after which a connection is closed on which nothing comes.
    """

    upload_bytes: int = 16 << 20
    request_bytes: int = 4096
    scans: int = 8
    seconds: float = 120.0
    start_seconds: float = 300.0
    waiting: int = 8
    unpolled_seconds: float = 20.0
    kept: int = 24
    connections: int = 100
    idle_seconds: int = 15

    def __post_init__(self) -> None:
        if not self.seconds > 0:
            raise ConfigError(f"{self.seconds:g} seconds for drawing", "more than 0", "raise it")

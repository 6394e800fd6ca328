"""Bounds on what a client of the server may ask for: numbers with their reasons, in one place."""

from dataclasses import dataclass

from lidargrit.core.errors import ConfigError

_SECONDS_AT_MOST = 86_400


@dataclass(frozen=True)
class Limits:
    """Bounds on size, time and number.

    Args:
        upload_bytes: largest uploaded file; a revolution of 128 rows by 2048 columns takes 12.6 MB as Ouster's PCD.
        request_bytes: longest JSON of a request.
        scans: largest number of scans in one request.
        seconds: longest time that one job may compute; the worker process is ended when it is over.
        start_seconds: longest time that the worker process may take to read the runs.
        waiting: largest number of jobs in the queue; a further client is asked to try again.
        unpolled_seconds: time after which a waiting job is dropped if its client no longer asks for it. Browsers let a
            hidden tab ask once a minute.
        kept: number of finished results that are kept; the oldest is removed first.
        connections: largest number of open connections, each of which holds at most one upload in memory.
        idle_seconds: time after which a connection is closed if no byte arrives on it.
    """

    upload_bytes: int = 16 << 20
    request_bytes: int = 4096
    scans: int = 8
    seconds: float = 120.0
    start_seconds: float = 300.0
    waiting: int = 8
    unpolled_seconds: float = 150.0
    kept: int = 24
    connections: int = 64
    idle_seconds: int = 15

    def __post_init__(self) -> None:
        if not 0 < self.seconds <= _SECONDS_AT_MOST:
            raise ConfigError(
                f"{self.seconds:g} seconds for one job",
                f"more than 0, at most {_SECONDS_AT_MOST:,}",
                "choose another number",
            )

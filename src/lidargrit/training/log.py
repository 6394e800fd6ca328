"""Loss terms of a stage in training → ``log.jsonl``, and TensorBoard's event files where that is installed."""

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

from lidargrit.core.errors import OutputError
from lidargrit.core.files import plain, write_text
from lidargrit.core.untrusted import parse_json

LOG_FILE = "log.jsonl"
_LINE_BYTES_AT_MOST = 2**16  # of one entry; an entry of twenty terms has a thousandth


def read_log(path: Path) -> list[dict[str, Any]]:
    """Return the entries of a log, without lines that are none, such as one that a killed process left cut short.

    Raises:
        OSError: the log cannot be read.
    """
    entries = []
    with path.open(encoding="utf-8", errors="replace") as log:
        while line := log.readline(_LINE_BYTES_AT_MOST):
            with suppress(ValueError):
                entry = parse_json(line, str(path))
                numbers = entry.get("scans_seen"), entry.get("seconds")
                if all(type(number) in (int, float) and number >= 0 for number in numbers):
                    entries.append(entry)
    return entries


class Log:
    """The log of one stage. Entries later than the checkpoint from which the stage resumes are removed.

    Args:
        scans_seen: number of scans seen at that checkpoint.
    """

    def __init__(self, folder: Path, scans_seen: int) -> None:
        self._path, self._resumed_at = folder / LOG_FILE, scans_seen
        self.validated = False
        """Whether there is an entry of the validation at the checkpoint from which the stage resumes."""
        self._board: Any = None
        if self._path.is_file():
            self._trim()

    def write(self, split: str, scans_seen: int, seconds: float, terms: dict[str, float]) -> None:
        """Add an entry."""
        line = {"scans_seen": scans_seen, "split": split, "seconds": round(seconds, 1), **terms}
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("a", encoding="utf-8") as log:
                log.write(json.dumps(plain(line)) + "\n")
            self._plot(split, scans_seen, terms)
        except OSError as error:
            raise OutputError(
                f"'{error.strerror}' while writing {self._path}", "a folder with room", "free some space and go on"
            ) from error

    def _plot(self, split: str, scans_seen: int, terms: dict[str, float]) -> None:
        try:
            from torch.utils.tensorboard import SummaryWriter  # noqa: PLC0415  slow to import, and an extra
        except ImportError:
            return
        if self._board is None:  # TensorBoard itself removes what was logged from purge_step on
            self._board = SummaryWriter(str(self._path.parent), purge_step=self._resumed_at + 1)
        for name, value in terms.items():
            self._board.add_scalar(f"{name}/{split}", value, scans_seen)
        self._board.flush()

    def close(self) -> None:
        """Close TensorBoard's file."""
        if self._board is not None:
            self._board.close()

    def _trim(self) -> None:
        kept = [entry for entry in read_log(self._path) if entry["scans_seen"] <= self._resumed_at]
        self.validated = any((e["scans_seen"], e.get("split")) == (self._resumed_at, "val") for e in kept)
        write_text(self._path, "".join(f"{json.dumps(entry)}\n" for entry in kept))

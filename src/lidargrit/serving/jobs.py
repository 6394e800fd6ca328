"""One drawing at a time for whoever asks: requests → results on disk, with a bounded queue and a limit of time."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import queue
import secrets
import shutil
import subprocess
import threading
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

from lidargrit import errors
from lidargrit.errors import DataError
from lidargrit.processes import module_command
from lidargrit.serving.limits import Limits
from lidargrit.serving.requests import SampleRequest, SamplingSetting

State = Literal["waiting", "working", "done", "failed"]


class Job:
    """One request, and what has become of it."""

    def __init__(self, request: SampleRequest, folder: Path) -> None:
        self.request, self.folder = request, folder
        self.state: State = "waiting"
        self.error = ""
        self.heard = time.monotonic()
        self.begun = self.ended = 0.0

    def seconds(self) -> float:
        """Return how long it has been at work, or was."""
        return (self.ended or time.monotonic()) - self.begun if self.begun else 0.0


class JobQueue:
    """Whoever asks first is drawn for first.

    Args:
        runs: folders of finished runs.
        folder: an empty folder for files that are needed only while this lives.
        device: where networks compute; "" for a GPU if there is one.
        limits: what may be asked for.

    Raises:
        LidarGritError: a run that cannot be read.
    """

    def __init__(self, runs: Sequence[Path], folder: Path, device: str = "", limits: Limits | None = None) -> None:
        self.limits = limits or Limits()
        self._folder, self._asked = folder, {"runs": [str(run) for run in runs], "device": device}
        self._jobs: dict[str, Job] = {}  # the oldest first
        self._waiting: deque[Job] = deque()
        self._changed = threading.Condition()
        self._closed = False
        self._numbers = itertools.count()
        self._process = _Process(self._asked)
        self.models = self._ready()
        self._thread = threading.Thread(target=self._run_jobs, daemon=True)
        self._thread.start()

    def __enter__(self) -> JobQueue:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._process.end()
        self._thread.join()

    def settings(self) -> list[list[SamplingSetting]]:
        """Return the numbers that can be chosen, of each model."""
        return [[SamplingSetting(**setting) for setting in model["settings"]] for model in self.models]

    def new_folder(self) -> Path:
        """Make an empty folder, for a result and what it is made of."""
        folder = self._folder / str(next(self._numbers))
        folder.mkdir()
        return folder

    def submit(self, request: SampleRequest, folder: Path) -> str | None:
        """Take on a request and return the name to ask for it by; None if too many are waiting already."""
        with self._changed:
            if len(self._waiting) >= self.limits.waiting:
                return None
            name = secrets.token_urlsafe(12)  # nobody guesses another's
            self._jobs[name] = job = Job(request, folder)
            self._waiting.append(job)
            self._forget()
            self._changed.notify()
        return name

    def job(self, name: str) -> Job | None:
        """Return a job, whose owner has asked for it just now."""
        with self._changed:
            job = self._jobs.get(name)
            if job is not None:
                job.heard = time.monotonic()
            return job

    def before(self, job: Job) -> int:
        """Return how many are drawn for before a job that waits."""
        with self._changed:
            return self._waiting.index(job) + 1 if job in self._waiting else 0

    def _forget(self) -> None:
        """Remove the oldest results beyond those that are kept."""
        ended = [name for name, job in self._jobs.items() if job.state in ("done", "failed")]
        for name in ended[: max(0, len(ended) - self.limits.kept)]:
            shutil.rmtree(self._jobs.pop(name).folder, ignore_errors=True)

    def _run_jobs(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if self._closed:
                    return
                job = self._waiting.popleft()
                job.state = "working"
            if time.monotonic() - job.heard > self.limits.unpolled_seconds:
                self._end(job, "nobody asked for it any more")
                continue
            self._end(job, self._drawn(job))

    def _drawn(self, job: Job) -> str:
        """Have a job done, and return what went wrong."""
        try:
            if not self._process.lives():
                self._process = _Process(self._asked)
                self._ready()
            job.begun = time.monotonic()
            self._process.say({"request": dataclasses.asdict(job.request), "folder": str(job.folder)})
            return self._process.answer(self.limits.seconds).get("refused", "")
        except TimeoutError:
            self._process.end()
            limit = f"{self.limits.seconds:g} seconds"
            return f"got a drawing that takes longer than {limit}; wanted a shorter one; ask for fewer scans or steps"
        except (OSError, EOFError, errors.LidarGritError):
            self._process.end()
            return "got a drawing that ended the program, perhaps for lack of memory; wanted a result; ask for less"

    def _end(self, job: Job, error: str) -> None:
        if job.request.file:
            Path(job.request.file).unlink(missing_ok=True)
        with self._changed:
            job.ended, job.error, job.state = time.monotonic(), error, "failed" if error else "done"

    def _ready(self) -> list[dict[str, Any]]:
        """Wait until the process has read the runs, and return what they can do."""
        try:
            answer = self._process.answer(self.limits.start_seconds)
        except (TimeoutError, EOFError):
            self._process.end()
            raise DataError("runs that could not be read", "to read them all", "see above, or name fewer") from None
        except BaseException:  # Ctrl-C
            self._process.end()
            raise
        if "error" in answer:
            self._process.end()
            name, *what = answer["error"]
            raise getattr(errors, name)(*what)
        return answer["models"]


class _Process:
    """The process that draws."""

    def __init__(self, asked: dict[str, Any]) -> None:
        command = module_command("lidargrit.serving", json.dumps(asked))
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
        )
        self._lines: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._listen, daemon=True).start()

    def lives(self) -> bool:
        return self._process.poll() is None

    def say(self, what: dict[str, Any]) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(what) + "\n")
        self._process.stdin.flush()

    def answer(self, seconds: float) -> dict[str, Any]:
        """Return the next answer, or raise TimeoutError, or EOFError if the process has ended."""
        try:
            line = self._lines.get(timeout=seconds)
        except queue.Empty:
            raise TimeoutError from None
        if not line:
            raise EOFError
        return json.loads(line)

    def end(self) -> None:
        self._process.kill()
        self._process.wait()
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):  # a request that it did not read
            self._process.stdin.close()

    def _listen(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout:
            for line in self._process.stdout:
                self._lines.put(line)
        self._lines.put("")

"""Jobs one after another: requests → results on disk, with a bounded queue and a limit of time for each."""

import contextlib
import dataclasses
import itertools
import json
import logging
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

from lidargrit.core import errors
from lidargrit.core.errors import DataError, LidarGritError
from lidargrit.core.processes import module_command
from lidargrit.viewer.serve.requests import LIMITS, Limits, SampleRequest, SamplingSetting

State = Literal["waiting", "running", "done", "failed"]


class Job:
    """A request, its state, and the folder of its result."""

    def __init__(self, request: SampleRequest, folder: Path) -> None:
        self.request, self.folder = request, folder
        self.state: State = "waiting"
        self.error = ""
        self.polled = time.monotonic()
        self.started = self.ended = 0.0

    def seconds(self) -> float:
        """Return for how long the job has computed."""
        return (self.ended or time.monotonic()) - self.started if self.started else 0.0


class JobQueue:
    """Runs jobs in the order in which they were submitted.

    Args:
        folder: an empty folder for uploads and results; the caller removes it.
    """

    def __init__(self, runs: Sequence[Path], folder: Path, device: str = "", limits: Limits = LIMITS) -> None:
        self.limits, self._folder = limits, folder
        self._options = {"runs": [str(run) for run in runs], "device": device}
        self._jobs: dict[str, Job] = {}  # the oldest first
        self._waiting: deque[Job] = deque()
        self._changed = threading.Condition()
        self._closed = False
        self._numbers = itertools.count()
        self._worker = WorkerProcess(self._options)
        self.models = self._loaded_models()
        self._thread = threading.Thread(target=self._run_jobs, daemon=True)
        self._thread.start()

    def __enter__(self) -> "JobQueue":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify()
            self._worker.end()  # no other is started from here on
        self._thread.join()

    def settings(self) -> list[list[SamplingSetting]]:
        """Return the numbers that a client may set, for each model."""
        return [[SamplingSetting(**setting) for setting in model["settings"]] for model in self.models]

    def new_folder(self) -> Path:
        """Make an empty folder for an upload and a result, or raise OSError."""
        folder = self._folder / str(next(self._numbers))
        folder.mkdir()
        return folder

    def submit(self, request: SampleRequest, folder: Path) -> str | None:
        """Add a job to the queue and return its name; None if the queue is full."""
        with self._changed:
            if len(self._waiting) >= self.limits.waiting:
                return None
            name = secrets.token_urlsafe(12)  # nobody guesses another's
            self._jobs[name] = job = Job(request, folder)
            self._waiting.append(job)
            self._remove_old_results()
            self._changed.notify()
        return name

    def job(self, name: str) -> Job | None:
        """Return a job by its name, and note that its client still asks for it."""
        with self._changed:
            job = self._jobs.get(name)
            if job is not None:
                job.polled = time.monotonic()
            return job

    def jobs_before(self, job: Job) -> int:
        """Return how many jobs run before a waiting one; 0 if it does not wait."""
        with self._changed:
            return self._waiting.index(job) + 1 if job in self._waiting else 0

    def _remove_old_results(self) -> None:
        """Remove the oldest results beyond the number that is kept."""
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
                job.state = "running"
            if time.monotonic() - job.polled > self.limits.unpolled_seconds:
                limit = f"{self.limits.unpolled_seconds:g} seconds"
                self._finish(
                    job,
                    f"got a request that its page did not ask about for {limit}; wanted a page that stays open; "
                    "press the button again",
                )
            else:
                self._finish(job, self._run(job))

    def _run(self, job: Job) -> str:
        """Let the worker process run a job, and return its error, "" if there is none.

        No exception leaves this method: it would end the thread, and every later job would wait for ever.
        """
        try:
            if not self._restart_if_ended():
                return "got a job while the server stops; wanted one before; ask again when it runs"
            job.started = time.monotonic()
            self._worker.send({"request": dataclasses.asdict(job.request), "folder": str(job.folder)})
            return str(self._worker.receive(self.limits.seconds).get("error", ""))
        except TimeoutError:
            self._worker.end()
            limit = f"{self.limits.seconds:g} seconds"
            return f"got a job that takes longer than {limit}; wanted a shorter one; ask for fewer scans or steps"
        except (OSError, EOFError, LidarGritError):
            self._worker.end()
        except Exception:
            logging.getLogger(__name__).exception("a job failed in a way that nobody foresaw")
            self._worker.end()
        return (
            "got a job during which the program ended, perhaps for lack of memory; wanted a result; "
            "ask for fewer scans, or try again"
        )

    def _restart_if_ended(self) -> bool:
        """Start a worker process anew if the last one ended; return False where the server stops and none is wanted."""
        with self._changed:
            if self._closed:
                return False
            if self._worker.is_alive():
                return True
            self._worker = WorkerProcess(self._options)
        self._loaded_models()
        return True

    def _finish(self, job: Job, error: str) -> None:
        if job.request.file:
            with contextlib.suppress(OSError):
                Path(job.request.file).unlink(missing_ok=True)
        with self._changed:
            job.ended, job.error, job.state = time.monotonic(), error, "failed" if error else "done"

    def _loaded_models(self) -> list[dict[str, Any]]:
        """Wait until the worker process has read the runs, and return its description of the models."""
        try:
            answer = self._worker.receive(self.limits.start_seconds)
        except (TimeoutError, EOFError):
            self._worker.end()
            raise DataError("runs that could not be read", "to read them all", "see above, or name fewer") from None
        except BaseException:  # Ctrl-C
            self._worker.end()
            raise
        if "refused" in answer:
            self._worker.end()
            name, *parts = answer["refused"]
            raise getattr(errors, name)(*parts)
        return answer["models"]


class WorkerProcess:
    """The process in which networks compute; it reads and answers lines of JSON."""

    def __init__(self, options: dict[str, Any]) -> None:
        command = module_command("lidargrit.viewer.serve", json.dumps(options))
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, encoding="utf-8", start_new_session=True
        )
        self._lines: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._listen, daemon=True).start()

    def is_alive(self) -> bool:
        """Return whether the process still runs."""
        return self._process.poll() is None

    def send(self, message: dict[str, Any]) -> None:
        """Write one message, or raise OSError if the process no longer reads."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(message) + "\n")
        self._process.stdin.flush()

    def receive(self, seconds: float) -> dict[str, Any]:
        """Return the next message."""
        try:
            line = self._lines.get(timeout=seconds)
        except queue.Empty:
            raise TimeoutError from None
        try:
            message = json.loads(line) if line.endswith("\n") else None
        except ValueError:
            message = None
        if not isinstance(message, dict):
            raise EOFError
        return message

    def end(self) -> None:
        """Kill the process and wait for its end."""
        self._process.kill()
        self._process.wait()
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):  # a message that it did not read
            self._process.stdin.close()

    def _listen(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout, contextlib.suppress(ValueError):  # bytes that are no text: the line ends here
            for line in self._process.stdout:
                self._lines.put(line)
        self._lines.put("")

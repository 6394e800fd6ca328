"""The runs of a bundle beside the one that samples: a condition → the run that was trained for what is known of it."""

from collections.abc import Callable, Iterator, Mapping
from typing import Generic, TypeVar

from lidargrit.data.run_folder import Job
from lidargrit.scans.condition import Observed

RunT = TypeVar("RunT")


class Bundle(Generic[RunT]):
    """Runs that complete scans in the place of a generator, each read when it is first needed.

    Args:
        runs: function that reads the run of each job.
    """

    def __init__(self, runs: Mapping[Job, Callable[[], RunT]]) -> None:
        self._runs, self._read = runs, dict[Job, RunT]()

    def shares(self, condition: Observed) -> Iterator[tuple[RunT | None, list[int]]]:
        """Yield each run with the indices of the scans that it completes; None for those that no run completes."""
        jobs: list[Job] = [job_of(condition[[index]]) for index in range(len(condition))]
        for job in dict.fromkeys(jobs):
            yield self._run(job), [index for index, each in enumerate(jobs) if each == job]

    def _run(self, job: Job) -> RunT | None:
        if job in self._runs and job not in self._read:
            self._read[job] = self._runs[job]()
        return self._read.get(job)


def job_of(condition: Observed) -> Job:
    """Return the job that completes a scan: ``raydrop`` where all surfaces are known, ``complete`` where pixels are.

    A scan of which nothing is known, or parts of both kinds, is left to the run that samples.
    """
    if condition.has_all_surfaces:
        return "raydrop"
    has_pixels = bool(condition.return_observed.any()) and "surfaces" not in condition.kinds
    return "complete" if has_pixels else "sample"

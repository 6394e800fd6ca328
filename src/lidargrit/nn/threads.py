"""How many threads share a network's steps on a CPU, where a step is too small to be worth it."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch

_SHARED_FROM_FLOPS = 1e8  # a step of the packaged model for 8 scans has 6.7e7: two threads save it a tenth of its time


@contextmanager
def threads_for(step_flops: int) -> Iterator[None]:
    """Compute with one thread meanwhile if steps are small and torch's threads spin while they wait for one another.

    Beside other work a thread that spins takes the processor from the very thread that it waits for, a hundred times a
    step. The command ``lidargrit`` lets threads sleep; other programs that load torch mostly do not, and OpenMP reads
    its variables only once.
    """
    threads = torch.get_num_threads()
    sleeps = os.environ.get("OMP_WAIT_POLICY", "").upper() == "PASSIVE"
    if sleeps or threads == 1 or step_flops >= _SHARED_FROM_FLOPS:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)

"""Sums and samples over the processes of a training, equal to those of one process with the whole batch."""

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor, distributed


def sum_over_processes(counted: Shaped[Tensor, "*shape"]) -> Shaped[Tensor, "*shape"]:
    """Add up a tensor over all processes, in place; with one process it is the sum already."""
    if _several():
        distributed.all_reduce(counted)
    return counted


def num_processes() -> int:
    """Return the number of processes that train together."""
    return distributed.get_world_size() if _several() else 1


def sample_from_all(rows: Float[Tensor, "n D"], count: int, rng: torch.Generator | None) -> Float[Tensor, "count D"]:
    """Sample rows, with repetition, from those of all processes.

    Every process gets the same rows, which the first process chooses. The rows of the processes follow one another, as
    their shares of a batch do.

    Args:
        rows: rows of this process; every process has equally many.
        rng: source of random numbers; that of the first process counts. None for torch's own.
    """
    if not _several():
        return rows[torch.randint(len(rows), (count,), generator=rng, device=rows.device)]
    everywhere = len(rows) * distributed.get_world_size()
    chosen = torch.randint(everywhere, (count,), generator=rng, device=rows.device)
    distributed.broadcast(chosen, src=0)
    index: Int[Tensor, "count"] = chosen - distributed.get_rank() * len(rows)
    is_mine = (index >= 0) & (index < len(rows))
    mine = torch.where(is_mine[:, None], rows[index.clamp(0, len(rows) - 1)], 0.0)
    return sum_over_processes(mine)


def of_first_process(tensor: Shaped[Tensor, "*shape"]) -> Shaped[Tensor, "*shape"]:
    """Return the first process's tensor in all of them, in place, where each computed it with errors of rounding."""
    if _several():
        distributed.broadcast(tensor, src=0)
    return tensor


def _several() -> bool:
    return distributed.is_available() and distributed.is_initialized()

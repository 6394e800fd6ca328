"""What each of several processes holds of a batch → what one process with the whole batch would hold."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor, distributed


def sum_over_processes(counted: Shaped[Tensor, "*shape"]) -> Shaped[Tensor, "*shape"]:
    """Add up, in place, what every process counted; in one process it is the sum already."""
    if _several():
        distributed.all_reduce(counted)
    return counted


def sample_from_all(rows: Float[Tensor, "n D"], count: int, rng: torch.Generator | None) -> Float[Tensor, "count D"]:
    """Draw rows, with repetition, from those of all processes; all get the rows that the first one's ``rng`` draws.

    The rows of the processes count as following one another, as the shares of a batch do.
    """
    if not _several():
        return rows[torch.randint(len(rows), (count,), generator=rng, device=rows.device)]
    everywhere = len(rows) * distributed.get_world_size()
    drawn = torch.randint(everywhere, (count,), generator=rng, device=rows.device)
    distributed.broadcast(drawn, src=0)
    place: Int[Tensor, "count"] = drawn - distributed.get_rank() * len(rows)
    is_mine = (place >= 0) & (place < len(rows))
    mine = torch.where(is_mine[:, None], rows[place.clamp(0, len(rows) - 1)], 0.0)
    return sum_over_processes(mine)


def _several() -> bool:
    return distributed.is_available() and distributed.is_initialized()

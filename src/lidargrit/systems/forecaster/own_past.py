"""A past whose last scans are the model's own samples, as in the drives that it generates → pasts to learn from."""

from collections.abc import Callable
from dataclasses import replace

import torch

from lidargrit.scans.fine_columns import in_fine_columns
from lidargrit.scans.past import Past
from lidargrit.scans.types import RangeImage

Sample = Callable[[Past, list[int]], RangeImage]


def with_own(past: Past, share: float, sample: Sample, rng: torch.Generator) -> Past:
    """Return pasts of which some end with scans that the model samples one after the other, each given those before.

    The first scan of a past stays true, so that what follows is still what the past tells.

    Args:
        share: probability that a past is one of these.
        sample: function from pasts and a seed for each to scans.
        rng: random numbers, on the device of the past.
    """
    batch, scans = past.ages_s.shape
    there = (past.range_m > 0).flatten(2).any(2)
    chosen = (torch.rand(batch, generator=rng, device=rng.device) < share).to(there.device) & there[:, :-1].any(1)
    steps = torch.randint(1, scans, (batch,), generator=rng, device=rng.device).tolist() if scans > 1 else [0] * batch
    seeds = torch.randint(1 << 31, (batch,), generator=rng, device=rng.device).tolist()
    range_m = past.range_m.clone()
    for number in chosen.nonzero()[:, 0].tolist():
        first = max(scans - steps[number], int(there[number].int().argmax()) + 1)
        for slot in range(first, scans):
            seen = _before(replace(past, range_m=range_m)[number : number + 1], slot)
            range_m[number, slot] = in_fine_columns(sample(seen, [seeds[number] + slot]))[0]
    return replace(past, range_m=range_m)


def _before(past: Past, slot: int) -> Past:
    """Return the past of one of its scans: the scans before it, seen from there, behind scans without a return."""
    scans = past.ages_s.shape[1]
    # A scan that lacks has no return and an age of 0.
    slots = torch.arange(scans, device=past.ages_s.device) - (scans - slot)
    there, at = slots >= 0, slots.clamp(min=0)
    transforms = torch.linalg.inv(past.transforms[:, slot : slot + 1]) @ past.transforms[:, at]
    still = torch.eye(4, dtype=transforms.dtype, device=transforms.device)
    return replace(
        past,
        range_m=past.range_m[:, at].where(there[:, None, None], 0.0),
        transforms=torch.where(there[:, None, None], transforms, still),
        ages_s=(past.ages_s[:, at] - past.ages_s[:, slot : slot + 1]).where(there, 0.0).clamp(min=0),
    )

"""The past as it is in use: perhaps none, displaced, of scans that keep few columns → pasts to learn from."""

from dataclasses import replace

import torch
from jaxtyping import Float64
from torch import Tensor

from lidargrit.scans.fine_columns import in_fine_columns
from lidargrit.scans.past import Past
from lidargrit.scans.types import RangeImage
from lidargrit.scans.warp import WarpedPast

_NONE, _SCAN_LOST = 0.15, 0.15  # probability that there is no past, and that one scan of it lacks
_THIN = 0.5  # that it is of generated scans, which keep few columns
_TURN_RAD, _SHIFT_M = 1e-3, 0.02  # standard deviation of errors of a pose
_JITTER_M = (0.0, 0.02, 0.06, 0.15)  # of ranges; one for each scan, half of it row by row


def worn(past: Past, rng: torch.Generator) -> Past:
    """Return a past in which scans may lack or keep few columns, and poses are not exact.

    Args:
        rng: random numbers, on the device of the past.
    """
    batch, scans = past.ages_s.shape
    device = past.range_m.device

    def chance(*size: int) -> Tensor:
        return torch.rand(size, generator=rng, device=device)

    there = (chance(batch, 1) >= _NONE) & (chance(batch, scans) >= _SCAN_LOST)
    thin = chance(batch) < _THIN
    range_m = past.range_m.where(there[..., None, None], 0.0)
    kept_m = range_m[..., :: past.sensor.column_stride].flatten(0, 1)
    if bool(thin.any()):
        filled_m = in_fine_columns(RangeImage(kept_m, kept_m > 0, past.sensor)).view_as(range_m)
        range_m = torch.where(thin[:, None, None, None], filled_m, range_m)
    errors = torch.randn((batch, scans, 6), generator=rng, device=device, dtype=torch.float64)
    errors *= chance(batch, 1, 1).round()
    return replace(past, range_m=range_m, transforms=_displaced(past.transforms, errors))


def jittered(warped: WarpedPast, rng: torch.Generator) -> WarpedPast:
    """Return warped returns whose ranges are wrong by centimetres, all of one ray alike, in most scans."""
    size, device = warped.copied_m.shape, warped.copied_m.device
    which = torch.randint(len(_JITTER_M), (size[0],), generator=rng, device=device)
    scale_m = torch.tensor(_JITTER_M, dtype=torch.float64, device=device)[which][:, None, None]
    of_row, of_ray = (
        torch.randn(shape, generator=rng, device=device, dtype=torch.float64) for shape in ((*size[:2], 1), size)
    )
    error_m = scale_m * (of_row + of_ray) / 2
    last, nearest, aligned, surface = (
        layer._replace(range_m=torch.maximum(layer.range_m + error_m, layer.range_m / 2).where(layer.range_m > 0, 0.0))
        for layer in (warped.last, warped.nearest, warped.aligned, warped.surface)
    )
    return replace(warped, last=last, nearest=nearest, aligned=aligned, surface=surface)


def _displaced(transforms: Float64[Tensor, "B K 4 4"], errors: Float64[Tensor, "B K 6"]) -> Float64[Tensor, "B K 4 4"]:
    """Return transforms with small errors: three of the turn, three of the place, as normal numbers."""
    x, y, z = (errors[..., :3] * _TURN_RAD).unbind(-1)
    none = torch.zeros_like(x)
    twist = torch.stack((none, -z, y, z, none, -x, -y, x, none), -1).unflatten(-1, (3, 3))
    error = torch.zeros_like(transforms)
    error[..., :3, :3] = torch.linalg.matrix_exp(twist)
    error[..., :3, 3] = errors[..., 3:] * _SHIFT_M
    error[..., 3, 3] = 1
    return error @ transforms

"""Range images that keep every n-th column → ranges in all fine columns, between the kept ones along the surfaces."""

import torch
from jaxtyping import Float
from torch import Tensor

from lidargrit.scans.types import RangeImage

_SAME_SURFACE = 0.1  # of a range: neighbours that differ by more are of two surfaces


def in_fine_columns(images: RangeImage) -> Float[Tensor, "B H fine_W"]:
    """Return ranges in metres in all fine columns of the sensor, 0 where nothing returns.

    Between two kept columns on one surface 1 / range is linear in the column, as on a plane; between others the nearer
    one is repeated. Kept columns stay as they are.

    Args:
        images: batch of range images (B, H, W).
    """
    stride = images.sensor.column_stride
    here = images.range_m.where(images.return_mask, 0.0).double()
    other = here.roll(-1, -1)
    both = (here > 0) & (other > 0) & ((here - other).abs() <= _SAME_SURFACE * torch.minimum(here, other))
    columns = [here]
    for step in range(1, stride):
        share = step / stride
        between = here * other / ((1 - share) * other + share * here)
        columns.append(torch.where(both, between, here if 2 * step <= stride else other))
    return torch.stack(columns, -1).flatten(-2).float()

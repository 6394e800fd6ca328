"""A range image → by how much the ranges of each row lie off the planes through its neighbours: offsets of lasers."""

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from lidargrit.scans.types import RangeImage

_ROWS, _COLUMNS = 9, 5  # of the patches: of a wall 10 m away an HDL-64E sees half a metre in so many rows
_APART = 1.5  # farthest range over nearest of one surface: ground is seen at grazing angles
_PLANE_M = 0.1  # root mean square residual of what is no plane: three times the offsets of an HDL-64E
_REACH_M = 40.0  # beyond, the ground's rows are too far apart for one plane
_FEWEST = 50  # residuals of a row, whose median then has an eighth of their spread


def plane_residuals(image: RangeImage) -> Float64[np.ndarray, "H"]:
    """Return the median over planes of range minus the plane's range in each row, in metres; NaN where planes are few.

    Patches of 9 rows and 5 columns that return everywhere within 40 m are taken for a plane where the best one lies
    within 10 cm of them, root mean square. In inverse range a plane is linear in the direction, so three numbers are
    fitted by least squares. A constant offset of a laser is in the residuals of all its planes; that part of it which
    neighbouring rows share, the plane takes over.

    Args:
        image: a single range image.
    """
    residual_m, row = _residuals(image)
    return np.array([np.median(of) if len(of := residual_m[row == at]) >= _FEWEST else np.nan for at in _rows(image)])


def row_offsets(images: list[RangeImage], rounds: int = 5, at_most_m: float = 0.15) -> Float64[np.ndarray, "H"]:
    """Return the offset that each row adds to all ranges, in metres: the median over images, 0 where none is known.

    Planes are fitted again to ranges without the offsets found so far, since the first residuals hold what is left
    of an offset after its plane has moved towards it. The offsets' mean is 0: walls do not tell it.

    Args:
        rounds: number of such fits; with five the offsets are found to a tenth of their size.
        at_most_m: largest size of an offset.
    """
    found_m = np.zeros(images[0].sensor.height)
    for _ in range(rounds):
        left = np.array([plane_residuals(_without(image, found_m)) for image in images])
        known = ~np.isnan(left).all(axis=0)
        found_m[known] += np.nanmedian(left[:, known], axis=0)
        found_m[known] -= found_m[known].mean()
    return np.clip(found_m, -at_most_m, at_most_m)


def _without(image: RangeImage, offset_m: Float64[np.ndarray, "H"]) -> RangeImage:
    range_m = (image.range_m - torch.from_numpy(offset_m).float()[:, None]).clamp(
        image.sensor.range_min_m, image.sensor.range_max_m
    )
    return RangeImage.masked(range_m, image.return_mask, image.sensor)


def _rows(image: RangeImage) -> range:
    return range(image.sensor.height)


def _residuals(image: RangeImage) -> tuple[Float64[np.ndarray, "n"], Float64[np.ndarray, "n"]]:
    """Return the residuals of all patches that are planes, in metres, and their rows."""
    height = image.sensor.height
    if height < _ROWS or image.sensor.width < _COLUMNS:
        return np.empty(0), np.empty(0)
    range_m = torch.where(image.return_mask, image.range_m, torch.nan).double()
    seen_m = _patches(range_m)
    near_m, far_m = seen_m.amin(dim=-1), seen_m.amax(dim=-1)  # NaN where a pixel has no return
    smooth = (far_m <= _APART * near_m) & (far_m <= _REACH_M)
    seen_m = seen_m[smooth]
    directions = torch.stack([_patches(part)[smooth] for part in image.sensor.ray_directions().double().unbind(-1)], -1)
    normal = torch.linalg.lstsq(directions, (1 / seen_m)[..., None]).solution
    residual_m = seen_m - 1 / (directions @ normal)[..., 0]
    plane = residual_m.square().mean(dim=-1).sqrt() <= _PLANE_M
    row = _patches(torch.arange(height).double()[:, None].expand_as(range_m))[smooth]
    return residual_m[plane].flatten().numpy(), row[plane].flatten().numpy()


def _patches(pixels: Float[Tensor, "H W"]) -> Float[Tensor, "h w n"]:
    """Return the pixels of all patches, which overlap in rows and lie side by side in columns."""
    return pixels.unfold(0, _ROWS, 1).unfold(1, _COLUMNS, _COLUMNS).flatten(start_dim=-2)

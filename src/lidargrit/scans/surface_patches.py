"""Range images → planes through small patches of pixels: offsets of lasers, range noise, readings."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from scipy.stats import chi2
from torch import Tensor

from lidargrit.scans.types import RangeImage

_ROWS, _COLUMNS = 9, 5  # of the patches: of a wall 10 m away an HDL-64E sees half a metre in so many rows
_APART = 3.0  # farthest range over nearest of one surface: ground is struck low, by rows up to 2 degrees apart
_PLANE_M = 0.1  # root mean square residual of what is no plane: three times the offsets of an HDL-64E
_REACH_M = 40.0  # beyond, the ground's rows are too far apart for one plane
_FEWEST = 50  # residuals of a row, whose median then has an eighth of their spread
_COS_AT_LEAST = 0.15  # of incidence, for offsets: lower on the ground, elevations wrong by .02 degrees show
_QUARTILE = 0.25  # of noise: planes with a step in them do not count
_DARK = 0.02  # mean reflectance of a plane below which two hundredths more or less are a matter of rounding
_NOISE_EDGES_M = (2.0, 6.0, 10.0, 15.0, 20.0, 30.0, 40.0)


@dataclass(frozen=True, eq=False)
class SurfacePatches:
    """Patches of 9 rows and 5 columns of one range image that are planes.

    A patch returns everywhere within 40 m, and the best plane lies within 10 cm of it, root mean square. In inverse
    range a plane is linear in the direction, so three numbers are fitted by least squares.

    Args:
        range_m: ranges of the patches' pixels, in metres.
        residual_m: range minus the plane's range.
        row: row of each pixel.
        normal_per_m: normal of each plane, as long as one over its distance from the sensor.
        reflectance: reflectances of the pixels; None if the image has none.
    """

    range_m: Float64[np.ndarray, "n 9 5"]
    residual_m: Float64[np.ndarray, "n 9 5"]
    row: Float64[np.ndarray, "n 9 5"]
    normal_per_m: Float64[np.ndarray, "n 3"]
    reflectance: Float64[np.ndarray, "n 9 5"] | None

    @classmethod
    def of(cls, image: RangeImage) -> "SurfacePatches":
        """Find the planes of a single range image; patches overlap in rows and lie side by side in columns."""
        height = image.sensor.height
        if height < _ROWS or image.sensor.width < _COLUMNS:
            nothing = np.empty((0, _ROWS, _COLUMNS))
            return cls(nothing, nothing, nothing, np.empty((0, 3)), None)
        range_m = torch.where(image.return_mask, image.range_m, torch.nan).double()
        seen_m = _patches(range_m)
        near_m, far_m = seen_m.amin(dim=-1), seen_m.amax(dim=-1)  # NaN where a pixel has no return
        smooth = (far_m <= _APART * near_m) & (far_m <= _REACH_M)
        seen_m, row = seen_m[smooth], _patches(torch.arange(height).double()[:, None].expand_as(range_m))[smooth]
        rays = image.sensor.ray_directions().double().unbind(-1)
        directions = torch.stack([_patches(part)[smooth] for part in rays], -1)
        normal = torch.linalg.lstsq(directions, (1 / seen_m)[..., None]).solution
        residual_m = seen_m - 1 / (directions @ normal)[..., 0]
        plane = residual_m.square().mean(dim=-1).sqrt() <= _PLANE_M

        def kept(pixels: Tensor) -> Float64[np.ndarray, "n 9 5"]:
            return pixels[plane].reshape(-1, _ROWS, _COLUMNS).numpy()

        read = None if image.reflectance is None else kept(_patches(image.reflectance.double())[smooth])
        return cls(kept(seen_m), kept(residual_m), kept(row), normal[plane][..., 0].numpy(), read)


def _patches(pixels: Tensor) -> Tensor:
    return pixels.unfold(0, _ROWS, 1).unfold(1, _COLUMNS, _COLUMNS).flatten(start_dim=-2)


def plane_residuals(image: RangeImage) -> Float64[np.ndarray, "H"]:
    """Return the median over planes of range minus the plane's range in each row, in metres; NaN where planes are few.

    Planes that are struck at more than 81 degrees are left out. A constant offset of a laser is in the residuals of
    all its planes, but for the part that neighbouring rows share, towards which the planes move.

    Args:
        image: a single range image.
    """
    found = SurfacePatches.of(image)
    # A plane's distance from the sensor over its range is the cosine of incidence.
    steep = found.range_m.mean((1, 2)) * np.linalg.norm(found.normal_per_m, axis=1) <= 1 / _COS_AT_LEAST
    residual_m, of_pixel = found.residual_m[steep], found.row[steep]
    of_rows = (residual_m[of_pixel == row] for row in range(image.sensor.height))
    return np.array([np.median(of) if len(of) >= _FEWEST else np.nan for of in of_rows])


def row_offsets(images: Sequence[RangeImage]) -> Float64[np.ndarray, "H"]:
    """Return the offset that each row adds to all ranges, in metres: the median over images, 0 where none is known.

    Planes are fitted again to ranges without the offsets found so far, since the first residuals hold what is left
    of an offset after its plane has moved towards it. The offsets' mean is 0: planes do not tell it.

    Args:
        images: single range images of one sensor.
    """
    found_m = np.zeros(images[0].sensor.height)
    for _ in range(5):  # they are then found to a tenth of their size
        left_m = np.array([plane_residuals(_without(image, found_m)) for image in images])
        known = ~np.isnan(left_m).all(axis=0)
        found_m[known] += np.nanmedian(left_m[:, known], axis=0)
        found_m[known] -= found_m[known].mean() if known.any() else 0
    return found_m


def _without(image: RangeImage, offset_m: Float64[np.ndarray, "H"]) -> RangeImage:
    limits_m = image.sensor.range_min_m, image.sensor.range_max_m
    range_m = (image.range_m - torch.from_numpy(offset_m).float()[:, None]).clamp(*limits_m)
    return RangeImage.masked(range_m, image.return_mask, image.sensor)


def range_noise(images: Sequence[RangeImage]) -> tuple[float, float] | None:
    """Return the standard deviation of the range noise near the sensor, in metres, and its growth per metre of range.

    The variance is that of a constant part plus one that grows as range squared. That of a patch is measured along its
    rows, where a laser's offset is constant; the lower quartile of patches in bins of range counts, divided by that
    of a chi-squared distribution. None if too few patches are found.

    Args:
        images: single range images of one sensor, in all columns that it fires.
    """
    patches = [SurfacePatches.of(image) for image in images]
    free = _ROWS * (_COLUMNS - 1) - 1  # rows have their means, and the plane its slope along them
    variance = np.concatenate(
        [((each.residual_m - each.residual_m.mean(2, keepdims=True)) ** 2).sum((1, 2)) / free for each in patches]
    )
    range_m = np.concatenate([each.range_m.mean((1, 2)) for each in patches])
    bins = np.digitize(range_m, _NOISE_EDGES_M)
    found = [
        (np.mean(range_m[bins == at] ** 2), np.quantile(variance[bins == at], _QUARTILE))
        for at in range(1, len(_NOISE_EDGES_M))
        if (bins == at).sum() >= _FEWEST
    ]
    if len(found) < 2:
        return None
    squared_m2, quartile_m2 = np.array(found).T
    variance_m2 = quartile_m2 / (chi2.ppf(_QUARTILE, free) / free)
    # Weighted by their size: errors of a variance grow with it.
    terms = np.stack((np.ones_like(squared_m2), squared_m2), axis=1) / variance_m2[:, None]
    constant, growth = np.linalg.lstsq(terms, np.ones_like(squared_m2))[0].clip(0)
    return float(np.sqrt(constant)), float(np.sqrt(growth))


def row_readings(images: Sequence[RangeImage]) -> Float64[np.ndarray, "H"] | None:
    """Return how much brighter each row reads a plane than the rows around it: a factor, 1 where too little is seen.

    It is the median over planes of a row's mean reflectance over the whole plane's. None without reflectance.

    Args:
        images: single range images of one sensor.
    """
    patches = [SurfacePatches.of(image) for image in images]
    ratios, rows = [], []
    for each in patches:
        if each.reflectance is None:
            return None
        whole = each.reflectance.mean((1, 2))
        lit = whole > _DARK
        ratios.append((each.reflectance[lit].mean(2) / whole[lit, None]).ravel())
        rows.append(each.row[lit, :, 0].ravel())
    ratio, row = np.concatenate(ratios), np.concatenate(rows)
    of_rows = (ratio[row == at] for at in range(images[0].sensor.height))
    return np.array([np.median(of) if len(of) >= _FEWEST else 1.0 for of in of_rows])

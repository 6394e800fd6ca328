"""Range images ⇄ images of horizontal distance and height, which have some of the rows and no holes."""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from lidargrit.core.errors import ConfigError, DataError
from lidargrit.data.images import RangeImages
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage

_LOWEST_M = (-41.1245, -25.8336, -2.3990)  # of x, y and z; points outside the box are no returns
_HIGHEST_M = (36.8332, 30.4740, 0.7383)
_NEAREST_M2 = 7.0  # squared horizontal distance, 2.65 m
_WINDOW = 5  # rows and columns from which a hole is filled at once
_ROUNDS_AT_MOST = 101
_LOOK_EVERY = 16  # rounds, on a GPU: a real scan takes about ten
_BATCH = 64


class FilledRows(nn.Module):
    """The image in which LidarGAN and its VAE see a scan, and its way back to a range image.

    A pixel has two values: horizontal distance d and height z, over one scale for all scans. Rows are the lowest first,
    and columns begin ahead of the sensor and turn to its left. Holes are filled from their neighbours, so every pixel
    returns. Returns outside a box around the car are holes too, and rows beyond the window are left out.

    Args:
        sensor: sensor of the range images, whose number of columns is a multiple of 16.
        first_row: index of the highest row that is kept.
        rows: number of rows that are kept: 24, 40, 56 or more in steps of 16.

    Source:
        Caccia et al., Deep Generative Modeling of LiDAR Data, IROS 2019; numbers from
        pclucas14/lidar_generation@2a2c8bc. There d is the mean of the points of a fine column, and every second column
        is dropped after the holes are filled; here the project's own projection chooses the points.
    """

    scale_m: Tensor

    def __init__(self, sensor: SensorModel, first_row: int, rows: int) -> None:
        super().__init__()
        if rows % 16 != 8 or rows < 24 or first_row < 0 or first_row + rows > sensor.height or sensor.width % 16:
            raise ConfigError(
                f"rows={rows} from first_row={first_row} of images of {sensor.height}x{sensor.width}",
                "24, 40, 56, ... rows that the sensor has, and columns in multiples of 16",
                "change model.rows, model.first_row or data.columns",
            )
        self.sensor, self.range = sensor, range(first_row, first_row + rows)
        self.register_buffer("scale_m", torch.tensor(max(map(abs, (*_LOWEST_M, *_HIGHEST_M)))))

    def fit(self, images: RangeImages) -> None:
        """Take the largest coordinate of all images as the scale."""
        largest_m = 0.0
        for first in range(0, len(images), _BATCH):
            batch = images.batch(range(first, min(first + _BATCH, len(images))))
            points, inside = self._boxed(batch)
            if not bool(inside.flatten(1).any(dim=1).all()):
                empty = first + int((~inside.flatten(1).any(dim=1)).nonzero()[0])
                names = images.provenance.names
                raise DataError(
                    f"no return near the car in {names[empty] if empty < len(names) else f'training scan {empty}'}",
                    f"one at least between rows {self.range[0]} and {self.range[-1]}, {_box()}",
                    "leave the scan out",
                )
            largest_m = max(largest_m, float(points.abs().max()))
        self.scale_m.fill_(largest_m)

    def encode(self, images: RangeImage) -> Float[Tensor, "B 2 rows W"]:
        """Map a batch to distance and height over the scale; an image without any return in the box is all 0."""
        points, _ = self._boxed(images)
        return fill_holes(_as_seen(distance_and_height(points))) / self.scale_m

    def decode(self, values: Float[Tensor, "B 2 rows W"]) -> RangeImage:
        """Map distance and height to range images in which every ray of the rows returns, and none of the others.

        The range is that of the pixel's own point; its ray is the sensor's, whichever height the point had.
        """
        range_m = _as_seen(values).square().sum(dim=1).sqrt() * self.scale_m
        whole = range_m.new_zeros(len(values), self.sensor.height, self.sensor.width)
        # A hair inside the limits, which in 32 bits may lie outside of themselves.
        near_m, far_m = self.sensor.range_min_m * (1 + 1e-6), self.sensor.range_max_m * (1 - 1e-6)
        whole[:, self.range.start : self.range.stop] = range_m.clamp(near_m, far_m)
        return RangeImage(whole, whole > 0, self.sensor)

    def _boxed(self, images: RangeImage) -> tuple[Float[Tensor, "B rows W 3"], Bool[Tensor, "B rows W"]]:
        """Return the points of the rows, and which of them are returns in the box; the others are 0."""
        rows = slice(self.range.start, self.range.stop)
        range_m = images.range_m[:, rows]
        points = range_m[..., None] * self.sensor.ray_directions()[rows].to(range_m)
        inside = in_box(points)
        return torch.where(inside[..., None], points, 0), inside


def in_box(points_xyz_m: Float[Tensor, "*shape 3"]) -> Bool[Tensor, "*shape"]:
    """Return which points lie in the box around the car, and not on the car itself."""
    lowest, highest = (points_xyz_m.new_tensor(corner) for corner in (_LOWEST_M, _HIGHEST_M))
    within = ((points_xyz_m >= lowest) & (points_xyz_m <= highest)).all(dim=-1)
    return within & (points_xyz_m[..., :2].square().sum(dim=-1) >= _NEAREST_M2)


def distance_and_height(points_xyz_m: Float[Tensor, "B H W 3"]) -> Float[Tensor, "B 2 H W"]:
    """Return the horizontal distance and the height of points as two channels."""
    return torch.stack((points_xyz_m[..., :2].square().sum(dim=-1).sqrt(), points_xyz_m[..., 2]), dim=1)


def fill_holes(image: Float[Tensor, "B 2 H W"]) -> Float[Tensor, "B 2 H W"]:
    """Fill pixels of distance 0 from the 5x5 pixels around them, again and again, for at most 101 rounds.

    Distance becomes the largest there and height the lowest, where holes have the height 0. An image of
    holes alone stays as it is.
    """
    looked_at = 1 if image.device.type == "cpu" else _LOOK_EVERY  # a further round changes nothing, a look waits
    rounds = 0 if image.is_meta else _ROUNDS_AT_MOST  # without values, operations are only counted: none here
    for done in range(rounds):
        holes = image[:, :1] == 0
        if done % looked_at == 0:
            share = holes.float().mean(dim=(1, 2, 3))
            if not bool(((share > 0) & (share < 1)).any()):
                break
        around = torch.cat((_highest_around(image[:, :1]), -_highest_around(-image[:, 1:])), dim=1)
        image = torch.where(holes, around, image)
    return image


def _highest_around(values: Float[Tensor, "B 1 H W"]) -> Float[Tensor, "B 1 H W"]:
    """Return the largest of the 5x5 pixels around each: down the columns, then along the rows, which is quicker."""
    half = _WINDOW // 2
    down = F.max_pool2d(values, (_WINDOW, 1), 1, (half, 0))
    return F.max_pool2d(down, (1, _WINDOW), 1, (0, half))


def _as_seen(image: Float[Tensor, "B C rows W"]) -> Float[Tensor, "B C rows W"]:
    """Turn an image of our order of rows and columns into that of the networks; done twice, it is what it was."""
    return image.flip(-2, -1).roll(-(image.shape[-1] // 2), dims=-1)


def _box() -> str:
    limits = [f"{low:g} < {axis} < {high:g} m" for axis, low, high in zip("xyz", _LOWEST_M, _HIGHEST_M, strict=True)]
    return f"{', '.join(limits)}, {math.sqrt(_NEAREST_M2):.2f} m away or more"

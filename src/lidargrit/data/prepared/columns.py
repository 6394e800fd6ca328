"""Prepared images → images of the same scans with fewer columns, as a projection to these would give them."""

import numpy as np

from lidargrit.core.errors import ConfigError
from lidargrit.data.images import ImageStore, Pixels
from lidargrit.scans.sensors import SensorModel


class FewerColumns:
    """Images of a store whose columns are gathered into fewer: of each new pixel, the nearest return stays.

    Where the number of columns falls to a whole part, these are the pixels that a projection of the points gives, but
    that of two returns in one step of the stored ranges either may stay.
    Otherwise a return goes to the new column in which the centre of its old one lies, up to half an old column from
    where its point lay.

    Args:
        images: store of images that are ``columns`` wide.
        columns: number of columns of the stored images.
        wanted: number of columns of the new images, at most as many.
    """

    def __init__(self, images: ImageStore, columns: int, wanted: int) -> None:
        self._images, self.provenance = images, images.provenance
        new_column = (np.arange(columns) * 2 + 1) * wanted // (2 * columns)
        self._first = np.searchsorted(new_column, np.arange(wanted))
        self._counts = np.diff(self._first, append=columns)

    def __len__(self) -> int:
        return len(self._images)

    def read(self, index: int) -> Pixels:
        """Return the pixels of one image."""
        range_m, planes = self._images.read(index)
        nearest_m = np.minimum.reduceat(np.where(range_m > 0, range_m, np.inf), self._first, axis=1)
        returned = np.isfinite(nearest_m)
        kept = dict[str, np.ndarray]()
        if planes:
            column = np.arange(range_m.shape[1])
            is_nearest = range_m == np.repeat(nearest_m, self._counts, axis=1)
            # Stored ranges have steps, so that several may be the nearest: the first gives its planes.
            found = np.minimum.reduceat(np.where(is_nearest, column, column[-1]), self._first, axis=1)
            for name, pixels in planes.items():
                kept[name] = np.where(returned, np.take_along_axis(pixels, found, axis=1), 0)
        return Pixels(np.where(returned, nearest_m, 0).astype(np.float32), kept)


def has_fewer_columns(sensor: SensorModel, other: SensorModel) -> bool:
    """Tell whether a sensor looks along another's rows, in fewer equal columns; both with all their fine columns."""
    if sensor.width >= other.width:
        return False
    try:
        return other.with_columns(sensor.width).same_rays(sensor)
    except ConfigError:  # a sensor with angles for every pixel
        return False

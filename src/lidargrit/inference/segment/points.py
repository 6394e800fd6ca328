"""A segmenter and a scan → a label for every point, also for those that fill no pixel of its range image."""

import numpy as np
import torch
from jaxtyping import Int, Int64
from torch import Tensor

from lidargrit.inference.complete.inputs import ScanReader
from lidargrit.inference.segment import label_images
from lidargrit.scans.projection.pixel_coordinates import PixelCoordinates
from lidargrit.scans.sensors import ProjectionOption
from lidargrit.scans.types import RangeImage, Scan
from lidargrit.systems.segmenter.system import Segmenter

_WINDOWS = ((1, 2), (3, 8))  # rows and columns around a point's pixel: the second where the first has no return


def labels_of_points(
    image: RangeImage, point_of_pixel: Int64[Tensor, "H W"], at: PixelCoordinates
) -> Int[Tensor, " n"]:
    """Return a label for every point.

    A point that fills a pixel has its label. Any other lies behind a nearer point of its pixel, beyond the sensor's
    limits, or above or below all rows: of the returns around its pixel (three rows and five columns; seven and 17
    where there is none) that one gives the label whose range is nearest to the point's. Where none returned, the
    label is 0.

    Args:
        image: labelled range image (H, W) of the scan.
        point_of_pixel: index of the point that fills each pixel, -1 for none.
        at: row, column and range of every point.

    Source:
        Milioto et al., RangeNet++, IROS 2019, section III-D, with one neighbour in place of five.
    """
    assert image.label is not None
    label_of_pixel, range_m = image.label.numpy(), image.range_m.numpy()
    label = np.zeros(len(at.range_m), np.int64)
    filled = point_of_pixel.numpy()
    label[filled[filled >= 0]] = label_of_pixel[filled >= 0]
    without = np.ones(len(label), bool)
    without[filled[filled >= 0]] = False
    height, width = range_m.shape
    for rows, columns in _WINDOWS:
        left = np.flatnonzero(without)
        down, right = (each.ravel() for each in np.mgrid[-rows : rows + 1, -columns : columns + 1])
        row = np.clip(at.row[left].astype(np.int64), 0, height - 1)[:, None] + down
        column = (at.column[left].astype(np.int64)[:, None] + right) % width
        inside = (row >= 0) & (row < height)
        row = np.clip(row, 0, height - 1)
        apart_m = np.abs(range_m[row, column] - at.range_m[left][:, None])
        apart_m[~inside | (range_m[row, column] == 0)] = np.inf
        nearest = apart_m.argmin(1)
        found = np.isfinite(apart_m[np.arange(len(left)), nearest])
        pixel = row[np.arange(len(left)), nearest], column[np.arange(len(left)), nearest]
        label[left[found]] = label_of_pixel[pixel][found]
        without[left[found]] = False
    return torch.from_numpy(label)


_FEW_RINGS_CURE = (
    "name a segmenter of the scans' sensor with --model, or train one: lidargrit train segmenter_compact RUN"
)


class PointLabels:
    """The labels that a segmenter finds for the points of scans.

    Args:
        segmenter: segmenter of a run.
        projection: way in which points find their rows.
    """

    def __init__(self, segmenter: Segmenter, projection: ProjectionOption = "sensor") -> None:
        self._segmenter = segmenter
        self._reader = ScanReader(segmenter.sensor.fine(), "exact", True, projection, _FEW_RINGS_CURE)

    def of(self, scan: Scan) -> tuple[Int[Tensor, " n"], str]:
        """Return a label for each point by :func:`labels_of_points`, and what makes them doubtful, "" for nothing.

        Raises:
            ScanError: a scan that has no range image of the segmenter's rows.
        """
        read = self._reader.read(scan)
        assert read.point_of_pixel is not None
        image = label_images(self._segmenter, RangeImage.stack([read.image]))[0]
        return labels_of_points(image, read.point_of_pixel, read.coordinates), read.doubt

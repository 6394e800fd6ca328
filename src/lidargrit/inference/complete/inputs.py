"""A user's scans → range images on the grid of a sensor, and the points that lie in their pixels."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Int64
from torch import Tensor

from lidargrit.core import reporting
from lidargrit.core.errors import ConfigError, ScanError
from lidargrit.data import formats
from lidargrit.data.formats import ScanFormat
from lidargrit.data.images import RangeImages
from lidargrit.data.prepared.config import DataConfig, ScanSettings
from lidargrit.data.sources import open_images, open_source
from lidargrit.data.sources.named import ImageScans, PointScans, named_scans
from lidargrit.inference.complete import Model
from lidargrit.inference.complete.grid import RayGrid
from lidargrit.scans.projection import (
    ProjectionVariant,
    index_map,
    project,
    project_by_what_fits,
    unproject,
)
from lidargrit.scans.projection.image import told_share
from lidargrit.scans.projection.pixel_coordinates import PixelCoordinates, pixel_coordinates
from lidargrit.scans.projection.sensor_check import has_few_rings, ring_count, told_doubts
from lidargrit.scans.sensors import ProjectionOption, SensorModel
from lidargrit.scans.types import RangeImage, Scan


@dataclass(frozen=True, eq=False)
class InputScan:
    """One scan of a user.

    Args:
        image: range image (H, W).
        points: points of the scan; None where it was an image.
        point_of_pixel: index of the point that fills each pixel, -1 for none; None where it was an image.
        on_grid: True for pixels that the scan covers; None for all.
        doubt: sign that another sensor than the named one made the scan, for a person; "" if there is none.
        pixels: row, column and range of every point; None where it was an image.
        by_ring: whether rows are rings.
        grid: rays of the image, as images of a model; None for the image alone.
        name: words by which a message calls a range image; points have a source.
    """

    image: RangeImage
    points: Scan | None = None
    point_of_pixel: Int64[Tensor, "H W"] | None = None
    on_grid: Bool[Tensor, "H W"] | None = None
    doubt: str = ""
    pixels: PixelCoordinates | None = None
    by_ring: bool = False
    grid: RayGrid | None = None
    name: str = "a range image"

    @property
    def rays(self) -> RayGrid:
        """Rays of the image, as images of a model."""
        return self.grid or RayGrid(self.image.sensor, self.image.sensor)

    @classmethod
    def of_image(cls, image: RangeImage) -> "InputScan":
        """Return a range image as a scan of points, one on the ray of each return."""
        row, column = (part.numpy() for part in image.return_mask.nonzero(as_tuple=True))
        range_m = image.range_m[image.return_mask].numpy()
        pixels = PixelCoordinates(row, column.astype(np.int32), range_m, image.sensor.height, image.sensor.width)
        return cls(image, unproject(image), pixels=pixels, by_ring=True)

    @property
    def cloud(self) -> Scan:
        """Points of the scan."""
        assert self.points is not None
        return self.points

    @property
    def coordinates(self) -> PixelCoordinates:
        """Row, column and range of every point."""
        assert self.pixels is not None
        return self.pixels

    def taken(self) -> Bool[Tensor, "H W"]:
        """Return the pixels in which a point lies, also one beyond the limits of range."""
        pixels, taken = self.coordinates, torch.zeros_like(self.image.return_mask)
        inside = pixels.in_rows()
        taken[pixels.row[inside].astype(np.int64), pixels.column[inside].astype(np.int64)] = True
        return taken


class Inputs:
    """The scans of a source, read one after the other.

    Args:
        scans: source of names, numbers, and points or images.
        reader: projection of points to range images.
    """

    def __init__(self, scans: PointScans | ImageScans, reader: "ScanReader") -> None:
        self.scans, self._reader = scans, reader
        self._counted = self._doubted = False

    def __len__(self) -> int:
        return len(self.scans)

    def suffix(self, index: int) -> str:
        """Return the ending of its file; "" where it is not in a file of points."""
        path = self.scans.path(index)
        return "" if path is None else path.name[len(formats.stem(path)) :]

    def form(self, index: int) -> type[ScanFormat] | None:
        """Return the format of its file; None where it has none."""
        path = self.scans.path(index)
        return None if path is None or not formats.candidates(path) else formats.recognise(path)

    def read(self, index: int, see: Callable[[Scan], InputScan] | None = None) -> InputScan:
        """Read one scan; tell once if another sensor seems to have made it, and how many points have no pixel.

        Args:
            see: function that brings a cloud to the rays that all of its points lie on; not given, it becomes one image
                of the reader's sensor. A range image stays as it is.
        """
        if isinstance(self.scans, ImageScans):
            return InputScan(self.scans.image(index), name=f"the range image {self.scans.identity(index).name}")
        points = self.scans.scan(index)
        self.scans.tell_notes(points)
        scan = self._reader.read(points) if see is None else see(points)
        if not self._counted and see is None:
            self._counted = True
            reporting.message(told_share(scan.image, len(points)))
        if scan.doubt and not self._doubted:
            reporting.message(f"WARNING: {scan.doubt}")
            self._doubted = True
        return scan


@dataclass(frozen=True)
class ScanReader:
    """How points become a range image.

    Args:
        variant: variant of the projection.
        partial: whether a scan of a part of the circle is accepted.
        projection: way in which points find their rows; ``sensor`` for what fits the points.
        few_rings_cure: cure of a scan of far fewer rows.
    """

    sensor: SensorModel
    variant: ProjectionVariant = "exact"
    partial: bool = False
    projection: ProjectionOption = "sensor"
    few_rings_cure: str = (
        "add the missing rows with: lidargrit upsample; a classical method completes them on their own sensor"
    )

    def read(self, scan: Scan) -> InputScan:
        """Project a scan; by elevation if its rings or its firing order do not fit, but not a file that was cut off."""
        if has_few_rings(scan, self.sensor):
            raise ScanError(
                f"{ring_count(scan)} rings in {scan.source}",
                f"the {self.sensor.height} of the sensor {self.sensor.name!r}",
                self.few_rings_cure,
            )
        if self.projection == "sensor":
            image, method, variant = project_by_what_fits(scan, self.sensor, self.variant, self.partial)
        else:
            method = self.projection
            variant = self.variant if method == self.sensor.projection else "exact"
            image = project(scan, self.sensor, method, variant, self.partial)
        at = index_map(scan, self.sensor, method, variant, self.partial)[:, :: self.sensor.column_stride]
        doubt = "; ".join(filter(None, told_doubts(scan, self.sensor, method)))
        pixels = pixel_coordinates(scan, self.sensor, method, variant)
        pixels = replace(pixels, column=pixels.column // self.sensor.column_stride, width=self.sensor.width)
        at = torch.from_numpy(at.astype(np.int64))
        return InputScan(image, scan, at, doubt=doubt, pixels=pixels, by_ring=method == "unfolding")


def images_for(models: Sequence[Model], source: str, settings: ScanSettings) -> RangeImages:
    """Return whole scans as range images that all models are compared on.

    They are projected as the first model's training scans were, unless a variant is named, with a warning if another
    model learned from images of another variant.

    Args:
        models: models and classical methods.
        settings: settings of reading and projecting them.
    """
    learned = [one.projection_variant for one in models if one.folder is not None]
    variant = settings.projection_variant or next(iter(learned), "exact")
    if {*learned} - {variant}:
        reporting.message(f"WARNING: scans are projected by {variant!r}, and some models learned from other images")
    data = replace(settings.data, projection_variant=variant)
    return open_images(source, data.with_projection(models[0].sensor), data)


def open_inputs(source: str, reader: ScanReader, config: DataConfig) -> Inputs:
    """Open the scans that a user named.

    Args:
        reader: projection of points to range images.
        config: number of scans, and what to do with unusable points.
    """
    scans = named_scans(open_source(source, config.bad_points), config, reader.sensor)
    if isinstance(scans, ImageScans) and not scans.images.sensor.same_rays(reader.sensor):
        of, wanted = scans.images.sensor, reader.sensor
        raise ConfigError(
            f"range images of {of.height}x{of.width} of the sensor {of.name!r} in {source}",
            f"images of the model's {wanted.height}x{wanted.width} of {wanted.name!r}, with the same rays",
            "name a model for such images with --model, or give the scans as points",
        )
    return Inputs(scans, reader)

"""Scan → range image, by spherical projection or by scan unfolding; range image → points on the rays of its pixels."""

import contextlib

import numpy as np
import torch
from jaxtyping import Float, Float32, Int32
from torch import Tensor

from lidargrit.core.errors import ScanError
from lidargrit.scans.classes import CLASS_BITS
from lidargrit.scans.projection.pixel_coordinates import ProjectionVariant, pixel_coordinates, within_limits
from lidargrit.scans.projection.sensor_check import fit_problems, projection_that_fits
from lidargrit.scans.sensors import ProjectionName, SensorModel
from lidargrit.scans.types import RangeImage, Scan


def project(
    scan: Scan,
    sensor: SensorModel,
    method: ProjectionName | None = None,
    variant: ProjectionVariant = "exact",
    partial: bool = False,
) -> RangeImage:
    """Assign each point of a scan to the pixel whose ray it lies on; the nearest point wins a pixel.

    Column w spans azimuths [edge - 2 pi w/W, edge - 2 pi (w+1)/W), where the sensor's ``first_edge_rad`` is the edge,
    +pi for most: pixel centres sit at w + 1/2, so that the first and last columns are as wide as the others. With a
    column stride, the columns between the kept ones are left out.

    Args:
        scan: points in the sensor's frame; for ``unfolding`` in firing order, or with their ring.
        sensor: sensor with the rays of the image and the range limits.
        method: projection method, ``spherical`` (rows by elevation) or ``unfolding`` (rows by ring); the sensor's own
            if not given.
        variant: ``exact`` floors, leaves out points beyond the sensor's span or limits before the nearest one wins, and
            refuses a scan that does not fit. ``clamped`` repeats the programs of R2DM, LiDARGen and LiDARCrafter: it
            moves points above or below all rows into the border rows, and loses a pixel whose nearest point is beyond
            the limits. ``reference`` repeats LidarGRIT's program: it does so too, and rounds; of scans that do not fit
            only those are refused of which most points would lie in rows where the sensor does not look.
        partial: whether a scan of a part of the circle is accepted. A pixel without a point is then unknown; it does
            not mean a beam that did not return.

    Returns:
        range_m (H, W) in metres and return_mask (H, W), with the planes reflectance and label if the scan has them.

    Raises:
        ConfigError: no method or variant of that name.
        ScanError: the scan does not fit the sensor, or its points are not in firing order; names the sensors that
            would fit, or the projection.

    Source:
        Haghighi et al., LidarGRIT, 2024, section 3.1, and its program @a3f86e7; kazuto1011/r2dm@ad66e71.
    """
    nearest = _nearest(scan, sensor, method, variant, partial, refuse=True)
    point_of_pixel, range_m = (array[:, :: sensor.column_stride] for array in nearest)
    filled = point_of_pixel >= 0
    if variant != "exact":  # there the limits are applied to the winner
        filled &= within_limits(range_m, sensor)
        if variant == "reference":  # strictly
            filled &= (range_m > sensor.range_min_m) & (range_m < sensor.range_max_m)
        point_of_pixel = np.where(filled, point_of_pixel, -1)
    if not filled.any():
        raise ScanError(
            f"no point between {sensor.range_min_m:g} and {sensor.range_max_m:g} m in {scan.source}",
            "returns within the sensor's range limits",
            "check that the file is in metres, or choose another sensor",
        )
    range_m = np.where(filled, range_m, np.float32(0))
    planes = dict[str, torch.Tensor]()
    if scan.reflectance is not None:
        of_point = np.append(scan.reflectance.numpy(), np.float32(0))  # that of no point, -1, is the last
        planes["reflectance"] = torch.from_numpy(of_point.take(point_of_pixel))
    if scan.label is not None:
        of_point = np.append(scan.label.long().numpy() & CLASS_BITS, 0)  # 8 bits do not hold that mask
        planes["label"] = torch.from_numpy(of_point.take(point_of_pixel))
    return RangeImage(torch.from_numpy(range_m), torch.from_numpy(filled), sensor, planes)


def project_by_what_fits(
    scan: Scan, sensor: SensorModel, variant: ProjectionVariant = "exact", partial: bool = False
) -> tuple[RangeImage, ProjectionName, ProjectionVariant]:
    """Return a scan's range image by the sensor's projection, or by elevation where rings or firing order do not fit.

    Args:
        scan, sensor, variant, partial: arguments of :func:`project`; the variant is that of the sensor's projection.

    Returns:
        the image, and the method and variant by which it was made.
    """
    method = projection_that_fits(scan, sensor)
    try:
        return _by_method(scan, sensor, method, variant, partial)
    except ScanError:
        if method == "spherical" or (scan.ring is None and not partial):
            raise
        with contextlib.suppress(ScanError):
            return _by_method(scan, sensor, "spherical", variant, partial)
        raise


def _by_method(
    scan: Scan, sensor: SensorModel, method: ProjectionName, variant: ProjectionVariant, partial: bool
) -> tuple[RangeImage, ProjectionName, ProjectionVariant]:
    # The reference variant of a projection by elevation knows no sensor.
    variant = variant if method == sensor.projection else "exact"
    return project(scan, sensor, method, variant, partial), method, variant


def told_share(image: RangeImage, num_points: int) -> str:
    """Return what a person reads of how many points of a set's first scan its image holds."""
    kept, size = int(image.return_mask.sum()), f"{image.sensor.height}x{image.sensor.width}"
    what = f"the image of {size} holds {kept:,} of the {num_points:,} points of the first scan"
    share = f"{kept / max(num_points, 1):.0%}, one a pixel"
    return f"{what} ({share}); the others are left out (a sensor or model of more columns keeps more)"


def index_map(
    scan: Scan,
    sensor: SensorModel,
    method: ProjectionName | None = None,
    variant: ProjectionVariant = "exact",
    partial: bool = False,
) -> Int32[np.ndarray, "H fine_W"]:
    """Return the index of the point that fills each pixel, -1 for none, before any column is left out.

    Args, Raises: as for :func:`project`; variants of programs take every scan here, as these do.
    """
    return _nearest(scan, sensor, method, variant, partial, refuse=variant == "exact")[0]


def _nearest(
    scan: Scan,
    sensor: SensorModel,
    method: ProjectionName | None,
    variant: ProjectionVariant,
    partial: bool,
    refuse: bool,
) -> tuple[Int32[np.ndarray, "H fine_W"], Float32[np.ndarray, "H fine_W"]]:
    method = method or sensor.projection
    pixels = pixel_coordinates(scan, sensor, method, variant)
    for problem in fit_problems(scan, sensor, method, pixels, partial, variant) if refuse else ():
        raise problem
    if variant != "exact":
        return pixels.nearest(np.ones(len(scan), dtype=bool))
    return pixels.nearest(pixels.in_rows() & within_limits(pixels.range_m, sensor))


def points_of_pixels(image: RangeImage) -> Float[Tensor, "*batch H W 3"]:
    """Return the point of every pixel in metres, the origin where there is no return; differentiable in the range."""
    return image.range_m[..., None] * image.sensor.ray_directions().to(image.range_m.device)


def unproject(image: RangeImage) -> Scan:
    """Return the points of one range image, row by row from the top, each on the centre of its pixel's ray.

    Returns:
        one point for each return, with its ring, and with reflectance and label if the image has them.

    Raises:
        ScanError: a batch instead of one image, or an image without a return.

    Example:
        >>> import lidargrit
        >>> scan = lidargrit.simulate(seed=0)
        >>> image = lidargrit.project(scan, lidargrit.load_sensor("hdl64e_kitti_360"))
        >>> len(lidargrit.unproject(image)) == int(image.return_mask.sum())
        True
    """
    if image.range_m.ndim != 2:
        raise ScanError(f"a batch of {len(image)} range images", "one", "unproject them one by one: batch[i]")
    returned = image.return_mask
    rows = torch.arange(image.sensor.height, device=returned.device)[:, None].expand_as(returned)
    return Scan(
        points_of_pixels(image)[returned],
        None if image.reflectance is None else image.reflectance[returned],
        rows[returned],
        None if image.label is None else image.label[returned],
        source="an unprojected range image",
    )

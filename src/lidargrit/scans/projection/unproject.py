"""Range image → points, each on its pixel's ray."""

import torch
from jaxtyping import Float
from torch import Tensor

from lidargrit.core.errors import ScanError
from lidargrit.scans.types import RangeImage, Scan


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

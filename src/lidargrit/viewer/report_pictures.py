"""Arrays → pictures inside a page: PNG as data URIs."""

import base64
import io

import numpy as np
from jaxtyping import Bool, Float, UInt8
from matplotlib import colormaps
from matplotlib.colors import LogNorm, Normalize, PowerNorm, to_rgb
from PIL import Image

NO_RETURN = "#e4e4e4"  # near white: no colour of the range scale comes near it
_WIDE, _TALL = 512, 128  # pixels of a range image on the page: 4 times wider than tall, twice as tall as it is
_VIEW = 300  # pixels of a view from above

Picture = str
"""A data URI."""


def range_picture(
    range_m: Float[np.ndarray, "H W"], finite: Bool[np.ndarray, "H W"], limits_m: tuple[float, float]
) -> Picture:
    """Render ranges from near (yellow) to far (violet) on a logarithmic scale, light grey where ``finite`` is False."""
    colours = colormaps["viridis_r"](LogNorm(*limits_m, clip=True)(np.where(finite, range_m, limits_m[0])))[..., :3]
    colours[~finite] = to_rgb(NO_RETURN)
    return _picture(_bytes(colours), (_WIDE, _TALL))


def rate_picture(rate: Float[np.ndarray, "H W"]) -> Picture:
    """Render shares from 0 (dark blue) to 1 (yellow)."""
    return _picture(_bytes(colormaps["cividis"](Normalize(0, 1)(rate))[..., :3]), (_WIDE, _TALL))


def colour_picture(colours: Float[np.ndarray, "H W 3"]) -> Picture:
    """Render red, green and blue, each from 0 to 1."""
    return _picture(_bytes(colours), (_WIDE, _TALL))


def density_picture(density: Float[np.ndarray, "x y"], highest: float) -> Picture:
    """Render a density seen from above, forward up and left to the left; colours follow its root."""
    colours = colormaps["magma"](PowerNorm(0.4, 0, max(highest, 1e-9), clip=True)(_upright(density)))[..., :3]
    return _picture(_bytes(colours), (_VIEW, _VIEW))


def difference_picture(difference: Float[np.ndarray, "x y"]) -> Picture:
    """Render a difference of densities: red where the first is denser, blue where the second is."""
    size = np.abs(difference)
    scaled = np.sign(difference) * (size / max(float(size.max()), 1e-9)) ** 0.4
    return _picture(_bytes(colormaps["RdBu_r"](Normalize(-1, 1)(_upright(scaled)))[..., :3]), (_VIEW, _VIEW))


def _upright(view: Float[np.ndarray, "x y"]) -> Float[np.ndarray, "x y"]:
    return view[::-1, ::-1]  # x grows forward, up on the page; y grows to the left


def _bytes(colours: Float[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    return (colours * 255).round().astype(np.uint8)


def _picture(pixels: UInt8[np.ndarray, "H W 3"], at_least: tuple[int, int]) -> Picture:
    """Encode pixels as PNG, each repeated until the picture has the given size, so that no browser blurs it."""
    wide, tall = (-(-wanted // size) for wanted, size in zip(at_least, pixels.shape[1::-1], strict=True))
    image = Image.fromarray(pixels.repeat(tall, axis=0).repeat(wide, axis=1))
    image = image.quantize(128, dither=Image.Dither.NONE)  # a third of the bytes, no difference to be seen
    data = io.BytesIO()
    image.save(data, "PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(data.getvalue()).decode()

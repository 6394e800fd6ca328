"""The two networks of a GAN of range images, whose azimuth wraps: latents → images, images → logits of being real."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from lidargrit.nn.convolution import wrapped
from lidargrit.nn.precision import without_autocast

LEVELS = 4  # times that rows and columns double, or halve

_SLOPE = 0.2  # of the leaky rectifier below 0
_GAIN = math.sqrt(2)  # keeps the size of signals through a rectifier that halves their power


@dataclass(frozen=True)
class Widths:
    """Channels of both networks.

    Args:
        finest: number of channels of the level next to the image; each coarser level has twice as many.
        widest: largest number of channels of any level.
    """

    finest: int
    widest: int

    def at(self, level: int) -> int:
        """Return the channels of a level, 0 being the finest."""
        return min(self.finest << level, self.widest)


class Synthesis(nn.Module):
    """A latent → an encoded range and logits of a return.

    A transposed convolution spreads the latent over the coarsest grid; three more double it, and one a map doubles it
    to the image.

    Args:
        size: rows and columns of the image, multiples of 16, with at least 32 rows.
        logits: number of maps of return logits beside the range; 0 for none.

    Source:
        The networks of DUSty v1 (Nakashima and Kurazume, IROS 2021), kazuto1011/dusty-gan@0374a5e, MIT.
    """

    def __init__(self, latent_dim: int, widths: Widths, size: tuple[int, int], logits: int) -> None:
        super().__init__()
        coarsest = (size[0] >> LEVELS, size[1] >> LEVELS)
        self.project = _Spread(latent_dim, widths.at(LEVELS - 1), coarsest)
        self.up = nn.ModuleList(_Double(widths.at(level), widths.at(level - 1)) for level in range(LEVELS - 1, 0, -1))
        self.range_head = _Double(widths.finest, 1)
        self.return_head = _Double(widths.finest, logits) if logits else None

    def forward(
        self, latents: Float[Tensor, "B D"]
    ) -> tuple[Float[Tensor, "B 1 H W"], Float[Tensor, "B logits H W"] | None]:
        """Generate the maps; the range is in [-1, 1]."""
        features = _rectify(self.project(latents[..., None, None]))
        for layer in self.up:
            features = _rectify(layer(features))
        logits = None if self.return_head is None else self.return_head(features)
        return torch.tanh(self.range_head(features).float()), logits


class Discriminator(nn.Module):
    """An encoded range image → the logit of its being real.

    It sees the image blurred along columns and blurred along rows, which hides single missing pixels.

    Source:
        As :class:`Synthesis`; the blur is that of Kaneko and Harada, NR-GAN, CVPR 2020.
    """

    def __init__(self, widths: Widths, size: tuple[int, int]) -> None:
        super().__init__()
        inputs = [2, *(widths.at(level) for level in range(LEVELS))]
        self.down = nn.ModuleList(
            _Convolution(a, b, (4, 4), 2, _GAIN if level else 1.0) for level, (a, b) in enumerate(pairwise(inputs))
        )
        self.verdict = _Convolution(inputs[-1], 1, (size[0] >> LEVELS, size[1] >> LEVELS), 1, _GAIN)

    def forward(self, images: Float[Tensor, "B 1 H W"]) -> Float[Tensor, "B"]:
        """Return the logit of each image."""
        # In 16 bits all that is farther than some 60 m would be next to the same value.
        with without_autocast(images.device):
            features = self.down[0](_pad(_blurred_both_ways(images)))
        for layer in self.down[1:]:
            features = layer(_pad(_rectify(features)))
        features = _rectify(features)
        return self.verdict(features)[:, 0, 0, 0]


class _Convolution(nn.Conv2d):
    """A convolution whose weights are all near 1 in size and are scaled when used, so that all learn at one speed.

    Source:
        Karras et al., Progressive Growing of GANs, 2018, section 4.1.
    """

    def __init__(self, inputs: int, outputs: int, kernel: tuple[int, int], stride: int, gain: float) -> None:
        super().__init__(inputs, outputs, kernel, stride)
        self.scale = _start(self, gain)

    def forward(self, input: Tensor) -> Tensor:
        return F.conv2d(input, self.weight * self.scale, self.bias, self.stride)


class _Spread(nn.ConvTranspose2d):
    """The same for a transposed convolution of a single pixel."""

    def __init__(self, inputs: int, outputs: int, kernel: tuple[int, int]) -> None:
        super().__init__(inputs, outputs, kernel)
        self.scale = _start(self, 1.0)

    def forward(self, input: Tensor, output_size: list[int] | None = None) -> Tensor:
        return super().forward(input * self.scale, output_size)  # not the weights, which here are most of the network's


class _Double(nn.ConvTranspose2d):
    """The same for a transposed convolution that doubles rows and columns, behind a rectifier."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(inputs, outputs, 4, 2)
        self.scale = _start(self, _GAIN)

    def forward(self, input: Tensor, output_size: list[int] | None = None) -> Tensor:
        # The padding takes 1 pixel off each side as usual, and the 2 that a padded pixel has become.
        return F.conv_transpose2d(_pad(input), self.weight * self.scale, self.bias, 2, padding=3)


def _start(layer: nn.Conv2d | nn.ConvTranspose2d, gain: float) -> float:
    """Set a layer's first weights at random, and return the factor by which they are multiplied when used.

    The factor is the program's, which for transposed convolutions counts outputs instead of inputs.
    """
    assert layer.bias is not None
    nn.init.normal_(layer.weight)
    nn.init.zeros_(layer.bias)
    return gain / math.sqrt(layer.weight[0].numel())


def _rectify(features: Tensor) -> Tensor:
    """Rectify; the program's gain behind it is in the scale of the layer that follows, which spares a pass."""
    return F.leaky_relu(features, _SLOPE)


def _pad(features: Tensor) -> Tensor:
    """Add a pixel on all sides: columns go around the circle, rows are mirrored."""
    wide = wrapped(features)
    return torch.cat((wide[..., 1:2, :], wide, wide[..., -2:-1, :]), dim=2)


def _blurred_both_ways(images: Tensor) -> Tensor:
    """Return the image averaged by 1:2:1 down each column, and along each row, as two channels."""
    padded = _pad(images)
    rows, columns = padded[..., 1:-1], padded[..., 1:-1, :]
    down = (rows[..., :-2, :] + 2 * rows[..., 1:-1, :] + rows[..., 2:, :]) / 4
    along = (columns[..., :-2] + 2 * columns[..., 1:-1] + columns[..., 2:]) / 4
    return torch.cat((down, along), dim=1)


_PUBLISHED_PREFIX = "backbone."  # of all names where raydrop is applied behind the network
_PUBLISHED_NAMES = {
    "0.0.module.weight": "project.weight",
    "0.1.bias": "project.bias",
    **{f"{level}.1.module.weight": f"up.{level - 1}.weight" for level in range(1, LEVELS)},
    **{f"{level}.2.bias": f"up.{level - 1}.bias" for level in range(1, LEVELS)},
    **{f"4.heads.depth.1.module.{kind}": f"range_head.{kind}" for kind in ("weight", "bias")},
    **{f"4.heads.confidence.1.module.{kind}": f"return_head.{kind}" for kind in ("weight", "bias")},
}


def from_published(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the weights of a published generator under the names of :class:`Synthesis`.

    Args:
        weights: ``G`` or ``G_ema`` of a checkpoint of DUSty v1. Its names are numbers of layers; ``module`` is the
            convolution within its scaling, ``heads.depth`` the range and ``heads.confidence`` the returns. Biases of
            hidden layers are those of the rectifiers behind them. ``drop_const`` is the value of no return, -1, and a
            learned temperature of the raydrop (``gumbel*.weight``) has no part in sampling: both are left out.

    Source:
        kazuto1011/dusty-gan@0374a5e, models/gans/dcgan_eqlr.py and models/dusty.py, MIT.
    """
    plain = {
        name.removeprefix(_PUBLISHED_PREFIX): weight
        for name, weight in weights.items()
        if name != "drop_const" and not name.startswith("gumbel")
    }
    return {_PUBLISHED_NAMES.get(name, name): weight for name, weight in plain.items()}

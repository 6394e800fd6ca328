"""Convolutions and residual blocks over range images, whose columns may close the circle of azimuth.

Parameter names follow the reference's state dict, so that published weights load.
"""

from typing import Any, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Shaped
from torch import Tensor, nn

from lidargrit.nn.blocks import Block, zeroed

Padding = Literal["zero", "wrap"]


def wrapped(x: Shaped[Tensor, "*B W"], left: int = 1, right: int = 1) -> Shaped[Tensor, "*B w"]:
    """Return maps with their last columns also before the first, and their first ones behind the last."""
    if torch.is_grad_enabled() and x.requires_grad:
        wide: Tensor = _Wrapped.apply(x, left, right)
        return wide
    return _wrapped(x, left, right)


def _wrapped(x: Tensor, left: int, right: int) -> Tensor:
    # Not by F.pad: its circular mode takes several times as long, most of all backwards.
    return torch.cat((x[..., x.shape[-1] - left :], x, x[..., :right]), dim=-1)


class _Wrapped(torch.autograd.Function):
    """:func:`wrapped` with a gradient of two sums, where that of slices and their concatenation fills three maps."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, left: int, right: int) -> Tensor:
        ctx.columns = left, right
        return _wrapped(x, left, right)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        (wide,), (left, right) = gradients, ctx.columns
        inner = wide[..., left : wide.shape[-1] - right].clone()
        if left:
            inner[..., -left:] += wide[..., :left]
        if right:
            inner[..., :right] += wide[..., -right:]
        return inner, None, None


class Convolution(nn.Conv2d):
    """A convolution that keeps the size; rows are padded with zeros, columns with zeros or around the circle.

    Args:
        inputs: number of channels of the input.
        outputs: number of channels of the output.
        padding: values beyond the first and the last column.
        kernel: odd number of rows, and number of columns, of the kernel. It may be an even number of columns where they
            wrap; the kernel then reaches one column further to the right than to the left.
    """

    def __init__(self, inputs: int, outputs: int, padding: Padding, kernel: tuple[int, int] = (3, 3)) -> None:
        rows, columns = kernel
        super().__init__(inputs, outputs, kernel, padding=(rows // 2, 0 if padding == "wrap" else columns // 2))
        self.wraps = padding == "wrap"
        self.left, self.right = (columns - 1) // 2, columns // 2

    def forward(self, input: Float[Tensor, "B C H W"]) -> Float[Tensor, "B D H W"]:
        """Convolve."""
        if not self.wraps:
            return super().forward(input)
        return super().forward(wrapped(input, self.left, self.right))


class Downsample(nn.Module):
    """Halve rows, columns or both by a 3x3 convolution; an axis that is halved is padded by one at its end alone.

    Args:
        channels: number of channels of the input and of the output.
        padding: values beyond the last column; beyond the rows there are zeros.
        row_stride: 2 to halve the rows; 1 to keep them.
        column_stride: 2 to halve the columns; 1 to keep them.
    """

    def __init__(self, channels: int, padding: Padding, row_stride: int = 2, column_stride: int = 2) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, channels, 3, stride=(row_stride, column_stride))
        self.wraps = padding == "wrap"
        self.above, self.left = 2 - row_stride, 2 - column_stride

    def forward(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C h w"]:
        """Halve the axes as made."""
        if self.wraps:
            return self.conv(F.pad(wrapped(x, left=self.left), (0, 0, self.above, 1)))
        return self.conv(F.pad(x, (self.left, 1, self.above, 1)))


class Upsample(nn.Module):
    """Double the rows, and perhaps the columns, by repeating pixels, then convolve.

    Args:
        channels: number of channels of the input and of the output.
        padding: values beyond the first and the last column.
        doubles_columns: whether columns are doubled, too.
    """

    def __init__(self, channels: int, padding: Padding, doubles_columns: bool = True) -> None:
        super().__init__()
        self.conv = Convolution(channels, channels, padding)
        self.factors = (2.0, 2.0 if doubles_columns else 1.0)

    def forward(self, x: Float[Tensor, "B C h w"]) -> Float[Tensor, "B C H W"]:
        """Repeat and convolve."""
        return self.conv(F.interpolate(x, scale_factor=self.factors, mode="nearest"))


class FoldedUpsample(nn.Module):
    """The same function as an :class:`Upsample` of both axes in 4/9 of the operations, without the repeated pixels.

    A repeated pixel meets the sum of neighbouring weights: an output pixel sees only 2x2 different inputs. Together the
    four kernels, one for each output pixel of an input's, are one transposed convolution of 4x4 weights and stride 2.
    """

    def __init__(self, upsample: Upsample) -> None:
        super().__init__()
        conv = upsample.conv
        self.wraps = conv.wraps
        shifts = [(right, 1 - right, down, 1 - down) for right in (0, 1) for down in (0, 1)]
        summed = torch.stack([F.pad(conv.weight.detach(), shift) for shift in shifts]).sum(0)
        self.weight = nn.Parameter(summed.transpose(0, 1).flip(2, 3).contiguous(), requires_grad=False)
        self.bias = conv.bias

    def forward(self, x: Float[Tensor, "B C h w"]) -> Float[Tensor, "B C H W"]:
        """Double the rows and the columns."""
        if not self.wraps:
            return F.conv_transpose2d(x, self.weight, self.bias, stride=2, padding=1)
        return F.conv_transpose2d(wrapped(x), self.weight, self.bias, stride=2, padding=(1, 3))


def group_norm(channels: int) -> nn.GroupNorm:
    """Return the reference's normalisation: epsilon 1e-6, 32 groups."""
    return nn.GroupNorm(32, channels, eps=1e-6)


class ResidualBlock(Block):
    """Norm, swish, convolution, twice, plus the input (through a 1x1 convolution if the channels change).

    Args:
        inputs: number of channels of the input.
        outputs: number of channels of the output.
        dropout: probability of dropout before the second convolution.
        padding: values beyond the first and the last column.
        kernel: rows and columns of both convolutions' kernels.

    Source:
        The block of the reference's first stage, hamedhaghighi/LidarGRIT@a3f86e7, without its time embedding.
    """

    def __init__(
        self, inputs: int, outputs: int, dropout: float, padding: Padding, kernel: tuple[int, int] = (3, 3)
    ) -> None:
        super().__init__()
        self.norm1 = group_norm(inputs)
        self.conv1 = Convolution(inputs, outputs, padding, kernel)
        self.norm2 = group_norm(outputs)
        self.dropout = nn.Dropout(dropout)
        self.conv2 = Convolution(outputs, outputs, padding, kernel)
        if inputs != outputs:
            self.nin_shortcut = nn.Conv2d(inputs, outputs, 1)

    def forward(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B D H W"]:
        """Add what the two convolutions find to the input."""
        h = self.conv1(F.silu(self.norm1(x), inplace=True))
        h = self.conv2(self.dropout(F.silu(self.norm2(h), inplace=True)))
        return (self.nin_shortcut(x) if self.conv1.in_channels != self.conv1.out_channels else x) + h


class Residual(Block):
    """Two convolutions whose sum with the input is the input at first."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv1, self.conv2 = Convolution(width, width, "wrap"), zeroed(Convolution(width, width, "wrap"))

    def forward(self, x: Float[Tensor, "B C h w"]) -> Float[Tensor, "B C h w"]:
        """Add what the two convolutions find to the input."""
        return x + self.conv2(F.silu(self.conv1(F.silu(x))))

"""LiDARGen's score network, NCSNv2 with two coordinate channels: (noisy image, noise level) → score.

Convolutions close the circle of azimuth, and join the top row to the bottom row, as the reference's do. Parameter names
follow the reference's state dict, so that published weights load.

Source:
    Song and Ermon, Improved Techniques for Training Score-Based Generative Models, NeurIPS 2020; Zyrianov et al.,
    LiDARGen, ECCV 2022; numbers from vzyrianov/lidargen@4c3226c (MIT).
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from lidargrit.nn.blocks import Block, Network
from lidargrit.nn.convolution import wrapped

_EPSILON = 1e-5  # of every norm, as in the reference
SIDE_AT_LEAST = 8  # pixels: at half the size, the widest convolutions reach 4 pixels beyond each border


class TorusConvolution(nn.Conv2d):
    """A 3x3 convolution that keeps the size and wraps both axes around.

    Args:
        dilation: distance in pixels between neighbouring weights.
    """

    def __init__(self, inputs: int, outputs: int, dilation: int = 1, bias: bool = True) -> None:
        super().__init__(inputs, outputs, 3, dilation=dilation, bias=bias)
        self.margin = dilation

    def forward(self, input: Float[Tensor, "B C H W"]) -> Float[Tensor, "B D H W"]:
        """Convolve."""
        margin = self.margin
        wide = wrapped(input, margin, margin)
        return super().forward(torch.cat((wide[..., -margin:, :], wide, wide[..., :margin, :]), dim=-2))


class HalvingConvolution(nn.Module):
    """A convolution padded with zeros, then the mean of every 2x2 pixels."""

    def __init__(self, inputs: int, outputs: int, kernel: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, padding=kernel // 2)

    def forward(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B D h w"]:
        """Halve the rows and the columns."""
        return F.avg_pool2d(self.conv(x), 2)


class InstanceNormPlus(nn.Module):
    """Normalise each channel of an image, and put back how its mean lies among those of the other channels.

    Args:
        channels: number of channels, at least 2.

    Source:
        Song and Ermon, Generative Modeling by Estimating Gradients of the Data Distribution, NeurIPS 2019, appendix A.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.alpha = nn.Parameter(torch.empty(channels).normal_(1, 0.02))
        self.gamma = nn.Parameter(torch.empty(channels).normal_(1, 0.02))
        self.beta = nn.Parameter(torch.zeros(channels))

    def forward(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C H W"]:
        """Normalise."""
        means = x.mean((2, 3))
        spread = (means.var(1, keepdim=True) + _EPSILON).sqrt()  # of the channels; the unbiased variance
        level = self.alpha * (means - means.mean(1, keepdim=True)) / spread
        normalised = F.instance_norm(x, eps=_EPSILON) + level[..., None, None]
        return self.gamma[:, None, None] * normalised + self.beta[:, None, None]


class NcsnBlock(Block):
    """Norm, ELU, convolution, twice, plus the input.

    Args:
        outputs: number of output channels; another number than ``inputs`` needs ``down``.
        down: whether the block begins a stage: it changes the number of channels and halves the size, or, if dilated,
            keeps the size; its shortcut is a convolution.
    """

    def __init__(self, inputs: int, outputs: int, dilation: int = 1, down: bool = False) -> None:
        super().__init__()
        halves = down and dilation == 1
        self.normalize1 = InstanceNormPlus(inputs)
        self.conv1 = TorusConvolution(inputs, inputs if down else outputs, dilation)
        self.normalize2 = InstanceNormPlus(inputs if down else outputs)
        self.conv2 = HalvingConvolution(inputs, outputs, 3) if halves else TorusConvolution(inputs, outputs, dilation)
        if down:
            shortcut = HalvingConvolution(inputs, outputs, 1) if halves else TorusConvolution(inputs, outputs, dilation)
            self.shortcut = shortcut
        self.down = down

    def forward(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B D h w"]:
        """Add what the two convolutions find to the input."""
        h = self.conv1(F.elu(self.normalize1(x)))
        h = self.conv2(F.elu(self.normalize2(h)))
        return (self.shortcut(x) if self.down else x) + h


class ResidualUnits(nn.ModuleDict):
    """Units of ELU, convolution, ELU, convolution, each of them added to its input."""

    def __init__(self, channels: int, units: int) -> None:
        names = [f"{unit}_{stage}_conv" for unit in range(1, units + 1) for stage in (1, 2)]
        super().__init__({name: TorusConvolution(channels, channels, bias=False) for name in names})

    def forward(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C H W"]:
        """Refine."""
        convolutions = list(self.values())
        for first, second in zip(convolutions[::2], convolutions[1::2], strict=True):
            x = x + second(F.elu(first(F.elu(x))))
        return x


class Fusion(nn.Module):
    """The sum of several inputs, each convolved and resized to the size of the first.

    Args:
        inputs: number of channels of each input.
    """

    def __init__(self, inputs: tuple[int, ...], outputs: int) -> None:
        super().__init__()
        self.convs = nn.ModuleList(TorusConvolution(channels, outputs) for channels in inputs)

    def forward(self, *inputs: Float[Tensor, "B _ _ _"]) -> Float[Tensor, "B D H W"]:
        """Add up."""
        size = inputs[0].shape[2:]
        found = [conv(x) for conv, x in zip(self.convs, inputs, strict=True)]
        resized = [F.interpolate(each, size, mode="bilinear", align_corners=True) for each in found]
        return torch.stack(resized).sum(0)


class ChainedPooling(nn.Module):
    """ELU, and twice the largest of 5x5 neighbours, convolved, added to it."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.convs = nn.ModuleList(TorusConvolution(channels, channels, bias=False) for _ in range(2))

    def forward(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C H W"]:
        """Add what lies around."""
        pooled = x = F.elu(x)
        for conv in self.convs:
            pooled = conv(F.max_pool2d(pooled, 5, stride=1, padding=2))
            x = x + pooled
        return x


class Refinement(Block):
    """A block of RefineNet: inputs of several sizes are refined, fused and pooled.

    Args:
        inputs: number of channels of each input.
        units: number of residual units at the end.

    Source:
        Lin et al., RefineNet, CVPR 2017.
    """

    def __init__(self, inputs: tuple[int, ...], outputs: int, units: int = 1) -> None:
        super().__init__()
        self.adapt_convs = nn.ModuleList(ResidualUnits(channels, 2) for channels in inputs)
        if len(inputs) > 1:
            self.msf = Fusion(inputs, outputs)
        self.crp = ChainedPooling(outputs)
        self.output_convs = ResidualUnits(outputs, units)
        self.fuses = len(inputs) > 1

    def forward(self, *inputs: Float[Tensor, "B _ _ _"]) -> Float[Tensor, "B D H W"]:
        """Return an image of the size of the first input."""
        adapted = [adapt(x) for adapt, x in zip(self.adapt_convs, inputs, strict=True)]
        return self.output_convs(self.crp(self.msf(*adapted) if self.fuses else adapted[0]))


class Ncsn(Network):
    """The score of noisy images, which is the gradient of their log density.

    Args:
        channels: number of channels of the finest level, twice as many in the others; 128 are published.
    """

    def __init__(self, image_channels: int, channels: int = 128) -> None:
        super().__init__()
        n = channels
        self.begin_conv = nn.Conv2d(image_channels + 2, n, 3, padding=1)
        self.res1 = nn.Sequential(NcsnBlock(n, n), NcsnBlock(n, n))
        self.res2 = nn.Sequential(NcsnBlock(n, 2 * n, down=True), NcsnBlock(2 * n, 2 * n))
        self.res3 = nn.Sequential(NcsnBlock(2 * n, 2 * n, 2, down=True), NcsnBlock(2 * n, 2 * n, 2))
        self.res4 = nn.Sequential(NcsnBlock(2 * n, 2 * n, 4, down=True), NcsnBlock(2 * n, 2 * n, 4))
        self.refine1 = Refinement((2 * n,), 2 * n)
        self.refine2 = Refinement((2 * n, 2 * n), 2 * n)
        self.refine3 = Refinement((2 * n, 2 * n), n)
        self.refine4 = Refinement((n, n), n, units=3)
        self.normalizer = InstanceNormPlus(n)
        self.end_conv = nn.Conv2d(n, image_channels, 3, padding=1)

    def forward(self, x: Float[Tensor, "B C H W"], sigma: Float[Tensor, "B"]) -> Float[Tensor, "B C H W"]:
        """Return the scores of images, whose clean values lie in [0, 1].

        Args:
            x: noisy images, with even numbers of rows and columns, at least 8 of each.
            sigma: standard deviation of the noise in each image. The network itself does not see it: only the scale of
                its answer depends on it, so that any level may be asked for.
        """
        count, _, height, width = x.shape
        columns = torch.linspace(0, 1, width, device=x.device).expand(count, 1, height, width)
        rows = torch.linspace(0, 1, height, device=x.device)[:, None].expand(count, 1, height, width)
        first = self.res1(self.begin_conv(torch.cat((2 * x - 1, columns, rows), dim=1)))
        second = self.res2(first)
        third = self.res3(second)
        refined = self.refine1(self.res4(third))
        refined = self.refine2(third, refined)
        refined = self.refine3(second, refined)
        refined = self.refine4(first, refined)
        return self.end_conv(F.elu(self.normalizer(refined))) / sigma[:, None, None, None]

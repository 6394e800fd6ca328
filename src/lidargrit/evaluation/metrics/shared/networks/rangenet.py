"""RangeNet-53, trained to tell 19 classes of a street apart: range images → 4096 values of its last feature map."""

import random
from collections import OrderedDict
from functools import lru_cache

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from lidargrit.evaluation.metrics.shared.networks.layers import FrozenNorm
from lidargrit.evaluation.metrics.shared.networks.weights import PublishedWeights

RANGENET_WEIGHTS = PublishedWeights(
    name="rangenet53",
    url="https://www.ipb.uni-bonn.de/html/projects/bonnetal/lidar/semantic/models/darknet53-1024.tar.gz",
    licence="that of its training data, says the README of PRBonn/lidar-bonnetal: SemanticKITTI, non-commercial",
    bytes_at_most=512_000_000,  # 50 million parameters take 202 MB
    sha256=None,  # not known: the file could not be had when this was written
    members={"darknet53-1024/backbone": "backbone.", "darknet53-1024/segmentation_decoder": "decoder."},
)

WIDTH_STEP = 32
"""Columns are halved five times on the way down, rows never."""

_CHANNELS = (32, 64, 128, 256, 512, 1024)
_BLOCKS = (1, 2, 8, 8, 4)  # Redmon and Farhadi, YOLOv3, 2018, table 1
_VALUES = 4096  # of LiDARGen and R2DM


class RangeNet53(nn.Module):
    """Backbone and decoder of RangeNet++; the head, which names classes, is left out.

    The names of its parts are those of the published weights, with ``backbone.`` or ``decoder.`` before them.

    Source:
        Milioto et al., RangeNet++, IROS 2019; PRBonn/lidar-bonnetal@76379a3 (MIT) for what the paper leaves open;
        kazuto1011/r2dm@ad66e71 for the choice of features.
    """

    def __init__(self) -> None:
        super().__init__()
        self.backbone, self.decoder = _Backbone(), _Decoder()

    def forward(self, images: Float[Tensor, "B 5 H W"]) -> Float[Tensor, "B d"]:
        """Return 4096 values of the decoder's 32 x H x W, always those at the same positions."""
        features = self.decoder(self.backbone(images)).flatten(1)
        return features[:, chosen_values(features.shape[1]).to(features.device)]


@lru_cache
def chosen_values(num: int) -> Int64[Tensor, "n"]:
    """Return which of ``num`` values are the features: the random choice of LiDARGen and R2DM, or all if fewer.

    Source:
        ``random.seed(0); random.sample(range(2097152), 4096)`` in vzyrianov/lidargen@4c3226c, for 32 x 64 x 1024.
    """
    return torch.tensor(random.Random(0).sample(range(num), min(num, _VALUES)))


class _Residual(nn.Module):
    def __init__(self, wide: int, narrow: int) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(wide, narrow, 1, bias=False), FrozenNorm(narrow)
        self.conv2, self.bn2 = nn.Conv2d(narrow, wide, 3, padding=1, bias=False), FrozenNorm(wide)

    def forward(self, x: Tensor) -> Tensor:
        return x + _leaky(self.bn2(self.conv2(_leaky(self.bn1(self.conv1(x))))))


class _Backbone(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(5, _CHANNELS[0], 3, padding=1, bias=False), FrozenNorm(_CHANNELS[0])
        for level, blocks in enumerate(_BLOCKS):
            narrow, wide = _CHANNELS[level : level + 2]
            down = nn.Conv2d(narrow, wide, 3, stride=(1, 2), padding=1, bias=False)
            layers = {"conv": down, "bn": FrozenNorm(wide), "relu": nn.LeakyReLU(0.1)}
            layers |= {f"residual_{block}": _Residual(wide, narrow) for block in range(blocks)}
            self.add_module(f"enc{level + 1}", nn.Sequential(OrderedDict(layers)))

    def forward(self, x: Tensor) -> list[Tensor]:
        """Return the features of every width, the widest first."""
        levels = [_leaky(self.bn1(self.conv1(x)))]
        for level in range(len(_BLOCKS)):
            levels.append(self.get_submodule(f"enc{level + 1}")(levels[-1]))
        return levels


class _Decoder(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        for level in range(len(_BLOCKS)):
            narrow, wide = _CHANNELS[level : level + 2]
            up = nn.ConvTranspose2d(wide, narrow, (1, 4), stride=(1, 2), padding=(0, 1))
            layers = {"upconv": up, "bn": FrozenNorm(narrow), "relu": nn.LeakyReLU(0.1)}
            layers |= {"residual": _Residual(narrow, wide)}
            self.add_module(f"dec{level + 1}", nn.Sequential(OrderedDict(layers)))

    def forward(self, levels: list[Tensor]) -> Tensor:
        """Widen step by step, adding what the backbone had at that width."""
        x = levels[-1]
        for level in reversed(range(len(_BLOCKS))):
            x = self.get_submodule(f"dec{level + 1}")(x) + levels[level]
        return x


def _leaky(x: Tensor) -> Tensor:
    return nn.functional.leaky_relu(x, 0.1)

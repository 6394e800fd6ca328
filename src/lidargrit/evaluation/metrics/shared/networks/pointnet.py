"""PointNet, trained to tell 16 kinds of objects apart: clouds in unit space → 1808 features of each."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from lidargrit.evaluation.metrics.shared.networks.layers import FrozenNorm
from lidargrit.evaluation.metrics.shared.networks.weights import PublishedWeights

POINTNET_WEIGHTS = PublishedWeights(
    name="pointnet",
    url="https://github.com/microsoft/SpareNet/raw/main/Frechet/cls_model_39.pth",
    licence="MIT, says the README of microsoft/SpareNet; trained on ShapeNet",
    bytes_at_most=32_000_000,  # 1.6 million parameters take 6.4 MB
    sha256=None,  # not known: the file could not be had when this was written
)

_POINTS = 2048  # at a time: 1024 features of each take 8 MB, which stay in the cache of a CPU: three times as fast


class PointNet(nn.Module):
    """The classifier without spatial transform of its features, as all programs that report this distance use it.

    The names of its parts are those of the published weights.

    Source:
        Qi et al., PointNet, CVPR 2017, figure 2; which layers are the features: Shu et al., TreeGAN, ICCV 2019, and
        kazuto1011/r2dm@ad66e71.
    """

    def __init__(self) -> None:
        super().__init__()
        self.feat = _GlobalFeatures()
        self.fc1, self.bn1 = nn.Linear(1024, 512), FrozenNorm(512)
        self.fc2, self.bn2 = nn.Linear(512, 256), FrozenNorm(256)
        self.fc3 = nn.Linear(256, 16)

    def forward(self, points: Float[Tensor, "B 3 n"]) -> Float[Tensor, "B 1808"]:
        """Return the pooled features, those of both hidden layers, and the 16 logits, side by side."""
        pooled = self.feat(points)
        first = F.relu(self.bn1(self.fc1(pooled)))
        second = F.relu(self.bn2(self.fc2(first)))
        return torch.cat((pooled, first, second, self.fc3(second)), dim=1)


class _PerPoint(nn.Module):
    """Three layers that treat every point alike, and the largest value of each feature over all points."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv1d(3, 64, 1), FrozenNorm(64)
        self.conv2, self.bn2 = nn.Conv1d(64, 128, 1), FrozenNorm(128)
        self.conv3, self.bn3 = nn.Conv1d(128, 1024, 1), FrozenNorm(1024)

    def pooled(self, points: Float[Tensor, "B 3 n"]) -> Float[Tensor, "B 1024"]:
        return torch.stack([self._features(some).amax(dim=2) for some in points.split(_POINTS, dim=2)]).amax(dim=0)

    def _features(self, x: Tensor) -> Tensor:
        x = F.relu(self.bn1(self.conv1(x)))
        return self.bn3(self.conv3(F.relu(self.bn2(self.conv2(x)))))


class _Alignment(_PerPoint):
    """The 3x3 matrix by which the cloud is brought into a pose of the network's choice."""

    def __init__(self) -> None:
        super().__init__()
        self.fc1, self.bn4 = nn.Linear(1024, 512), FrozenNorm(512)
        self.fc2, self.bn5 = nn.Linear(512, 256), FrozenNorm(256)
        self.fc3 = nn.Linear(256, 9)

    def forward(self, points: Tensor) -> Tensor:
        hidden = F.relu(self.bn4(self.fc1(F.relu(self.pooled(points)))))
        matrix = self.fc3(F.relu(self.bn5(self.fc2(hidden)))).view(-1, 3, 3)
        return matrix + torch.eye(3, device=matrix.device)


class _GlobalFeatures(_PerPoint):
    def __init__(self) -> None:
        super().__init__()
        self.stn = _Alignment()

    def forward(self, points: Tensor) -> Tensor:
        return self.pooled(self.stn(points).mT @ points)

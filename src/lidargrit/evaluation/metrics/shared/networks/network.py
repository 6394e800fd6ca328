"""A network's name and the file with its weights → features of images."""

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn

from lidargrit.core.errors import WeightsError
from lidargrit.evaluation.metrics.shared.networks.pointnet import POINTNET_WEIGHTS, PointNet
from lidargrit.evaluation.metrics.shared.networks.rangenet import RANGENET_WEIGHTS, RangeNet53
from lidargrit.evaluation.metrics.shared.networks.weights import PublishedWeights, find_weights, read_weights
from lidargrit.nn.devices import usable_device

NETWORKS: dict[str, tuple[PublishedWeights, Callable[[], nn.Module]]] = {
    published.name: (published, build)
    for published, build in ((POINTNET_WEIGHTS, PointNet), (RANGENET_WEIGHTS, RangeNet53))
}
"""The published weights of each network and the class that they fill, by its name."""

_BATCH = 8  # images at a time elsewhere than on a CPU, which is no faster with several; RangeNet-53 takes 0.1 GB each


class PretrainedNetwork:
    """A network with published weights that is only evaluated: images in, features out.

    Pickled, it is the name of its file; whoever unpickles it reads that file.
    """

    def __init__(self, name: str, path: Path, device: str) -> None:
        published, build = NETWORKS[name]
        weights, self.sha256 = read_weights(published, path)
        self.name, self.path, self._device = name, path, usable_device(device)
        self._module = filled(build, weights, path).to(self._device)

    def __reduce__(self) -> tuple[Any, ...]:
        return load_network, (self.name, self.path, str(self._device))

    def features(self, images: Float[Tensor, "B ..."]) -> Float32[np.ndarray, "B d"]:
        """Return the features of a batch, on the CPU."""
        step = 1 if self._device.type == "cpu" else _BATCH
        parts = [self._forward(part) for part in images.float().split(step)]
        return np.concatenate(parts)

    @torch.no_grad()
    def _forward(self, images: Float32[Tensor, "b ..."]) -> Float32[np.ndarray, "b d"]:
        # TensorFloat-32 would change the fourth digit of the features from one graphics card to the next.
        with torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True, allow_tf32=False):
            features = self._module(images.to(self._device)).cpu().numpy()
        if not np.isfinite(features).all():
            raise WeightsError(
                f"features that are not finite from {self.name} with {self.path}",
                "weights that came from training",
                "remove the file and get it again",
            )
        return features


def load_network(name: str, weights: Path | None = None, device: str = "cpu") -> PretrainedNetwork:
    """Return a network with its published weights; the same object while its file stays the same.

    Args:
        name: name of the network, one of ``NETWORKS``.
    """
    path = find_weights(NETWORKS[name][0], weights)
    status = path.stat() if path.is_file() else None
    return _loaded(name, path, device, status and (status.st_size, status.st_mtime_ns))


@lru_cache(maxsize=2)  # the two that there are
def _loaded(name: str, path: Path, device: str, _file: tuple[int, int] | None) -> PretrainedNetwork:
    return PretrainedNetwork(name, path, device)


def filled(build: Callable[[], nn.Module], weights: dict[str, Tensor], source: Path) -> nn.Module:
    """Make a network and give it weights of the very same layout."""
    with torch.device("meta"):  # takes no memory and no random numbers for what is replaced anyway
        module = build()
    wanted = {name: tensor.shape for name, tensor in module.state_dict().items()}
    given = {name: tensor.shape for name, tensor in weights.items()}
    for name in sorted(wanted.keys() | given.keys()):
        if wanted.get(name) != given.get(name):
            got, want = (tuple(shapes[name]) if name in shapes else "nothing" for shapes in (given, wanted))
            raise WeightsError(
                f"weights in {source} that are not of {build.__name__} ({got} for {name!r})",
                f"{want} there",
                "give the file that was published for this network",
            )
    module.load_state_dict(weights, assign=True)
    return module.requires_grad_(False)

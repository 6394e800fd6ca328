"""Frozen networks that an objective computes with, and images encoded by one, each once: range images → tensors."""

from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

import torch
from jaxtyping import Shaped
from torch import Tensor, nn

from lidargrit.nn.precision import in_full
from lidargrit.scans.example import keys_of
from lidargrit.scans.types import RangeImage

_BYTES_AT_MOST = 1 << 30  # 65,000 latents of LiDM's small preset, or a million times 256 tokens

NetworkT = TypeVar("NetworkT", bound=nn.Module)


class Frozen(Generic[NetworkT]):
    """A trained network that an objective computes with; it is not trained, averaged, copied or saved with it.

    Args:
        network: trained network, which is set to evaluation mode.
    """

    def __init__(self, network: NetworkT) -> None:
        self._network = network.eval()

    def network(self, device: torch.device) -> NetworkT:
        """Return the network on a device."""
        return self._network.to(device)

    def __deepcopy__(self, memo: dict[int, object]) -> "Frozen[NetworkT]":
        return self


class EncodingCache(Frozen[NetworkT]):
    """What a frozen network makes of images, computed once for all times that training sees an image.

    An image is known again by its key, the hash of its pixels, so that augmented images are told apart. Results stay on
    the device of the images. Once a bound of memory is reached, further images are encoded anew each time. They are
    encoded in full precision, as outside of training, and on a CPU one by one: the result does not depend on what else
    is in a batch, nor on whether training was resumed, and it takes no longer, since one image fits the processor's
    caches.

    Args:
        network: trained network, which is set to evaluation mode.
        encode: function of the network and images that returns one tensor for each image, stacked.
        bytes_at_most: bound of the memory that the results take.
    """

    def __init__(
        self, network: NetworkT, encode: Callable[[NetworkT, RangeImage], Tensor], bytes_at_most: int = _BYTES_AT_MOST
    ) -> None:
        super().__init__(network)
        self._encode = encode
        self._kept: dict[bytes, Tensor] = {}
        self._free = bytes_at_most

    @torch.no_grad()
    def __call__(self, images: RangeImage, keys: Sequence[bytes] | None = None) -> Shaped[Tensor, "B ..."]:
        """Return the results of a batch, on its device.

        Args:
            keys: keys of the images (:attr:`Example.keys`); computed here if not given, where the host waits for a GPU.
        """
        if images.range_m.is_meta:  # without values, where operations are only counted
            return self._encoded(images)
        keys = keys_of(images) if keys is None else keys
        new = [index for index, key in enumerate(keys) if key not in self._kept]
        parts = [[index] for index in new] if images.range_m.device.type == "cpu" else [new] if new else []
        found = {index: one for part in parts for index, one in zip(part, self._encoded(images[part]), strict=True)}
        results = [found[index] if index in found else self._kept[key] for index, key in enumerate(keys)]
        for index, result in found.items():
            if result.nbytes <= self._free and keys[index] not in self._kept:
                self._free -= result.nbytes
                self._kept[keys[index]] = result.clone()  # not a view of the whole batch
        return torch.stack([result.to(images.range_m.device) for result in results])

    def _encoded(self, images: RangeImage) -> Tensor:
        device = images.range_m.device
        with in_full(device):
            return self._encode(self.network(device), images)

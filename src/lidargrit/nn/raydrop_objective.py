"""What trains a network of raydrop: scans, with the ranges of all surfaces or without → the terms of a loss."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from jaxtyping import Bool
from torch import Tensor

from lidargrit.conditions.fills import ranges_from_others
from lidargrit.errors import ConfigError
from lidargrit.nn.objective import Objective
from lidargrit.nn.raydrop_network import RaydropNetwork
from lidargrit.nn.semantic_classes import hidden_in_some, labels_to_learn
from lidargrit.sensors import SensorModel
from lidargrit.structures import RangeImage

_NOISE_M = 0.03  # largest standard deviation of noise added in training: clean ranges may come with noise or not
_ALONE_WEIGHT = 0.5
_WITHOUT_LABELS = 0.25  # of the scans, so that a network with classes drops returns of scans without labels, too


class RaydropObjective(Objective):
    """The likelihood of which surfaces return, in phases and pixel by pixel.

    Args:
        network: network that is trained.
        sensor: sensor whose raydrop it learns.
    """

    def __init__(self, network: RaydropNetwork, sensor: SensorModel) -> None:
        super().__init__(sensor)
        self.raydrop = network

    def forward(self, images: RangeImage, rng: torch.Generator, player: str = "") -> dict[str, Tensor]:
        """Return the loss, and beside it the bits of a surface's return.

        Raises:
            ConfigError: scans whose surfaces are not marked, unless surfaces are to be estimated; or scans without
                labels, for a network with classes.
        """
        if self.raydrop.config.surfaces == "estimated":
            surfaces, returned = ranges_from_others(images, rng), images.return_mask
        else:
            surfaces, returned = images, self._returned(images)
        range_m, surface = surfaces.range_m, surfaces.return_mask
        if self.training:
            noise = torch.randn(range_m.shape, generator=rng, device=rng.device)
            most = torch.rand((len(range_m), 1, 1), generator=rng, device=rng.device) * _NOISE_M
            range_m = (range_m + noise * most).clamp(min=self.sensor.range_min_m)
        label = None
        if self.raydrop.classes is not None:
            label = hidden_in_some(labels_to_learn(images.label), _WITHOUT_LABELS, rng)
        found = self.raydrop(range_m, surface, label)
        count = surface.float().sum((1, 2)).clamp(min=1)
        nats = self.raydrop.mask.nats(found.guide, returned, rng if self.training else None) / count
        alone = F.binary_cross_entropy_with_logits(found.logits, returned.float(), reduction="none")
        alone = (alone * surface).sum((1, 2)) / count
        bits = {"mask_bits": nats.mean().detach() / math.log(2), "alone_bits": alone.mean().detach() / math.log(2)}
        return {"loss": (nats + _ALONE_WEIGHT * alone).mean(), **bits}

    def _returned(self, images: RangeImage) -> Bool[Tensor, "B H W"]:
        """Return which surfaces return, by their reflectance."""
        reflectance = images.reflectance
        if reflectance is not None and reflectance.is_meta:  # without values, where operations are only counted
            return images.return_mask
        if reflectance is None or bool(((reflectance - reflectance.round()).abs() > 1e-3).any()):
            raise ConfigError(
                "training scans that do not mark which of their surfaces return",
                "scans of every surface, whose reflectance is 1 for a return and 0 for none",
                "name such scans, as data.train=simulated_surfaces:512:train, or set model.raydrop.surfaces=estimated",
            )
        return images.return_mask & (reflectance > 0.5)

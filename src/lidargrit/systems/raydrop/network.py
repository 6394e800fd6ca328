"""A network of raydrop: the ranges of all surfaces → which of them return, sampled in phases, and how bright."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lidargrit.core.configuration import Settings
from lidargrit.core.errors import ConfigError
from lidargrit.core.typed_values import Count
from lidargrit.generation.any_sensor import RayNetwork
from lidargrit.generation.pixel_decoder.mask_network import MaskNetwork
from lidargrit.generation.pixel_decoder.phase_network import LOGIT_BOUND, Guide
from lidargrit.generation.reflectance import TYPICAL_REFLECTANCE
from lidargrit.generation.semantic_classes import ClassMaps, class_indices
from lidargrit.nn.small_unet import Part, SmallUnet, SmallUnetConfig, check_size
from lidargrit.scans.condition import Observed
from lidargrit.scans.planes import planes_of
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import TYPICAL_LOG_RANGE, RangeImage

_EDGE = 0.5  # of ln(range): neighbours further apart lie on two surfaces
_NUM_MAPS = 8
_CLASS_CHANNELS = 4  # learned, of the label of a surface


@dataclass(frozen=True)
class RaydropNetworkConfig(Settings):
    """Sizes of the network of raydrop, and what it learns from.

    Args:
        surfaces: source of the surfaces' ranges in training. ``known``: training scans have a point on every surface,
            marked by its reflectance: 0.5 + half of what is read where the sensor gets a return (1 if it is not known),
            and 0 where it gets none, as in ``simulated_surfaces``.
            ``estimated``: training scans are ordinary ones, and the range of every ray is triangulated from the returns
            of other rays, whether it returned itself or not.
        widths: channels at a half, a quarter and an eighth of the image's rows and columns.
        blocks: residual blocks at an eighth.
        features: channels that the phases of the mask see.
        mask_width: channels of the layers of the mask's phases.
        row_channels: learned numbers of every row.
        any_sensor: whether the network is told the angles of each row, by a small perceptron, in place of numbers that
            are learned row by row, so that the weights serve every spinning sensor.
        labels: whether the network sees the classes of the surfaces, where scans have them: the 19 classes of
            SemanticKITTI's benchmark.
        reflectance: whether the network estimates the reflectance of what returns.
    """

    surfaces: Literal["known", "estimated"] = "known"
    widths: tuple[Count, Count, Count] = (32, 48, 64)
    blocks: Count = 2
    features: Count = 24
    mask_width: Count = 24
    row_channels: Count = 2
    any_sensor: bool = False
    labels: bool = False
    reflectance: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.labels and self.surfaces == "estimated":
            raise ConfigError(
                "labels=true with surfaces=estimated, which has no label where nothing returned",
                "surfaces that are known, or no labels",
                "leave one of both out",
            )


class RaydropOutput(NamedTuple):
    """Output of the network for every ray.

    Args:
        guide: inputs of the phases of the mask, with the network's absent rows.
        logits: logits of the probability of a return by itself, with their gradient.
        reflectance: reflectance if the surface returns, with its gradient, not yet limited to [0, 1]; None from a
            network without it.
    """

    guide: Guide
    logits: Float[Tensor, "B H W"]
    reflectance: Float[Tensor, "B H W"] | None = None


class RaydropNetwork(RayNetwork):
    """A small U-Net over the ranges of all surfaces, and a mask that is sampled in phases behind it."""

    def __init__(self, config: RaydropNetworkConfig, sensor: SensorModel) -> None:
        super().__init__(sensor, config.any_sensor)
        check_size(self.grid.height, sensor.width, "a network of raydrop")
        self.config = config
        self._tell_rays(config.row_channels)
        elevation_rad = self.grid.elevation_rad.double().mean(1).float()
        self.register_buffer("elevation_rad", elevation_rad, persistent=False)
        sizes = SmallUnetConfig(config.widths, config.blocks)
        self.classes = ClassMaps(_CLASS_CHANNELS) if config.labels else None
        parts = {"labels": Part(_CLASS_CHANNELS, 0)} if config.labels else {}
        if config.reflectance:
            parts["reflectance"] = Part(0, 1)
        self.unet = SmallUnet(sizes, _NUM_MAPS + config.row_channels + 2, config.features + 1, parts)
        self.mask = MaskNetwork.behind(config.features, config.mask_width, self)

    elevation_rad: Tensor

    def made_for(self, sensor: SensorModel) -> "RaydropNetwork":
        """Return a new network of the same sizes for another sensor."""
        return RaydropNetwork(self.config, sensor)

    def forward(
        self, range_m: Float[Tensor, "B H W"], surface: Bool[Tensor, "B H W"], label: Int[Tensor, "B H W"] | None = None
    ) -> RaydropOutput:
        """Return features and logits of every ray.

        Args:
            surface: True where a ray meets a surface; no other ray returns.
            label: class of each surface, 0 where it is not known; of use to a network with classes.
        """
        range_m, surface = self.padded(range_m), self.padded(surface)
        maps = torch.cat((self._maps(range_m, surface), self.ray_maps(len(range_m))), 1)
        more, own = dict[str, Tensor](), slice(self.sensor.height)
        if self.classes is not None:
            label = torch.zeros_like(surface, dtype=torch.int64) if label is None else self.padded(label)
            more["labels"] = self.classes(class_indices(label)[:, None])
        output, of_parts = self.unet(maps, more)
        features, logits = output.float().split((self.config.features, 1), 1)
        v = torch.where(surface, range_m, 0.0).log1p()
        logits = (2 * logits[:, 0] + 1.5).clamp(-LOGIT_BOUND, LOGIT_BOUND)
        reflectance = None
        if self.config.reflectance:
            reflectance = TYPICAL_REFLECTANCE + of_parts["reflectance"].float()[:, 0, own]
        return RaydropOutput(Guide(features, v, logits.detach(), ~surface), logits[:, own], reflectance)

    def sample(self, condition: Observed, rngs: Sequence[torch.Generator]) -> RangeImage:
        """Return the surfaces that return, of each scan by its own random numbers; ranges stay as they are.

        Reflectance is a point estimate, which depends on no random number.

        Args:
            condition: surfaces of as many scans: the range of every ray that meets one, and no return for all other
                rays.
        """
        images, uniform = [], self.mask.uniform(rngs, condition.earlier_seeds)
        for index in range(len(rngs)):
            one = condition[index : index + 1]
            found = self(one.range_m, one.range_observed, one.label)
            returned = self.mask.sample(found.guide, uniform[index : index + 1], self.padded_condition(one))
            returned = returned[:, : self.sensor.height]
            reflectance = None if found.reflectance is None else found.reflectance.clamp(0, 1)
            planes = planes_of(reflectance=reflectance, label=one.label)
            images.append(RangeImage.masked(one.range_m, returned, condition.sensor, planes))
        return RangeImage.cat(images)

    def _maps(self, range_m: Float[Tensor, "B H W"], surface: Bool[Tensor, "B H W"]) -> Float[Tensor, "B 8 H W"]:
        """Return maps of surfaces, ranges, their differences in four directions, and the incidence from these."""
        log_m = torch.where(surface, range_m, 1.0).log()
        steps, slopes = [], []
        circle = 2 * math.pi / range_m.shape[-1] * self.elevation_rad.cos()[:, None]
        apart = -self.elevation_rad.diff()
        for axis in (-1, -2):
            sides = []
            for direction in (1, -1):
                beside, there = log_m.roll(direction, axis), surface.roll(direction, axis) & surface
                angle = circle
                if axis == -2:  # rows do not close a circle
                    angle = torch.cat((apart[:1], apart) if direction == 1 else (apart, apart[-1:]))[:, None]
                    there = there.clone()
                    there[:, 0 if direction == 1 else -1] = False
                step = log_m - beside
                steps.append(torch.where(there, step, 0.0).clamp(-2, 2))
                sides.append(torch.where(there & (step.abs() < _EDGE), step.abs() / angle.abs(), torch.inf))
            slope = torch.minimum(*sides)  # the nearer neighbour lies on the same surface, if one of both does
            slopes.append(torch.where(slope.isfinite(), slope, 0.0))
        log_cos = -0.5 * (1 + slopes[0].square() + slopes[1].square()).log()
        near = torch.where(surface, range_m.log1p() - TYPICAL_LOG_RANGE, 0.0)
        maps = [surface.to(near.dtype), near, *(4 * step for step in steps), log_cos, log_cos.exp()]
        return torch.stack(maps, 1)

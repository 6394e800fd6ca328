"""A network that completes scans: observed pixels and classical fills → range, return, reflectance and class."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lidargrit.core.typed_values import Count, NotNegative
from lidargrit.generation.any_sensor import RayNetwork
from lidargrit.generation.pixel_decoder.mask_network import MaskNetwork
from lidargrit.generation.pixel_decoder.phase_network import LOGIT_BOUND, Guide
from lidargrit.generation.reflectance import TYPICAL_REFLECTANCE
from lidargrit.generation.semantic_classes import NUM_CLASSES, ClassMaps, class_indices, labels_of, votes
from lidargrit.nn.small_unet import Part, SmallUnet, SmallUnetConfig, check_size
from lidargrit.scans.condition import Observed
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage
from lidargrit.systems.completion.classical_features import (
    LABELLED,
    NUM_CANDIDATES,
    NUM_LABELS,
    NUM_MAPS,
    NUM_REFLECTANCES,
    REFLECTING,
    ClassicalFeatures,
    classical_features,
)

_TRUST = 3.0  # logit by which triangulation is preferred to the other candidates at first
_CLASS_CHANNELS = 4  # learned, of each label that the network sees
_VOTE = 5.0  # logit of a class for which all observed labels around a pixel speak
_ONE_SURFACE = 0.1  # of ln(1 + range): a return so much farther or nearer than a pixel has a logit lower by 1


@dataclass(frozen=True)
class CompletionNetworkConfig(SmallUnetConfig):
    """Sizes of the network that completes scans, those of its U-Net among them.

    Attention fills a wide gap by what stands on the other side of the street, too.

    Args:
        features: number of channels that the phases of the mask see.
        mask_width: number of channels of the layers of the mask's phases.
        row_channels: number of learned values of every row.
        any_sensor: whether the network is told the angles of each row, by a small perceptron, in place of values that
            are learned row by row, so that the weights serve every spinning sensor.
        labels: whether the network sees the classes of observed pixels, where scans have them, and estimates those of
            the others: the 19 classes of SemanticKITTI's benchmark.
        reflectance: whether the network sees the reflectance of observed pixels, where scans have it, and estimates
            that of the others.
    """

    widths: tuple[Count, Count, Count] = (48, 64, 128)
    blocks: Count = 4
    attention_layers: NotNegative = 2
    heads: Count = 4
    features: Count = 32
    mask_width: Count = 24
    row_channels: Count = 2
    any_sensor: bool = False
    labels: bool = False
    reflectance: bool = False


class CompletionOutput(NamedTuple):
    """Point estimate of every pixel by the network.

    Args:
        guide: inputs of the phases of the mask, with the network's absent rows.
        v: ln(1 + range in metres), with its gradient.
        return_logits: logits of the probability of a return by itself, with their gradient.
        class_logits: logits of the classes, with their gradient; None from a network without classes.
        reflectance: reflectance, with its gradient, not yet limited to [0, 1]; None from a network without it.
    """

    guide: Guide
    v: Float[Tensor, "B H W"]
    return_logits: Float[Tensor, "B H W"]
    class_logits: Float[Tensor, "B 19 H W"] | None = None
    reflectance: Float[Tensor, "B H W"] | None = None


class CompletionNetwork(RayNetwork):
    """A small U-Net that weighs the ranges of classical methods, and a mask that is sampled in phases behind it.

    Range and reflectance are point estimates, the best single guess, and no samples; the mask is sampled, each phase
    given the observed pixels and the earlier phases, so that drops cluster as real ones do.
    """

    def __init__(self, config: CompletionNetworkConfig, sensor: SensorModel) -> None:
        super().__init__(sensor, config.any_sensor)
        check_size(self.grid.height, sensor.width, "a network that completes scans")
        self.config = config
        self.limits_v = (math.log1p(sensor.range_min_m), math.log1p(sensor.range_max_m))
        self._tell_rays(config.row_channels)
        self.classes = ClassMaps(_CLASS_CHANNELS) if config.labels else None
        self.outputs = [config.features, NUM_CANDIDATES, 1, 1]
        parts = {}
        if config.labels:
            parts["labels"] = Part(NUM_LABELS * _CLASS_CHANNELS, NUM_CLASSES + NUM_LABELS)
        if config.reflectance:
            parts["reflectance"] = Part(NUM_REFLECTANCES, 1 + NUM_REFLECTANCES)
        self.unet = SmallUnet(config, NUM_MAPS + config.row_channels + 2, sum(self.outputs), parts)
        self.mask = MaskNetwork.behind(config.features, config.mask_width, self)
        preferred = torch.zeros(NUM_CANDIDATES)
        preferred[0] = _TRUST
        self.register_buffer("preferred", preferred[:, None, None], persistent=False)

    preferred: Tensor

    def made_for(self, sensor: SensorModel) -> "CompletionNetwork":
        """Return a new network of the same sizes for another sensor."""
        return CompletionNetwork(self.config, sensor)

    def forward(self, classical: ClassicalFeatures, observed: Bool[Tensor, "B H W"]) -> CompletionOutput:
        """Return the estimate of every pixel.

        Args:
            observed: True where it was observed whether there is a return.
        """
        classical, observed = classical.mapped(self.padded), self.padded(observed)
        more: dict[str, Tensor] = {}
        seen, indices = classical.reflectances, None
        if self.classes is not None:
            label = classical.labels
            if label is None:
                label = classical.maps.new_zeros((len(observed), NUM_LABELS, *observed.shape[1:]), dtype=torch.int64)
            indices = class_indices(label)
            more["labels"] = self.classes(indices)
        if self.config.reflectance:
            if seen is None:
                seen = classical.maps.new_full(
                    (len(observed), NUM_REFLECTANCES, *observed.shape[1:]), TYPICAL_REFLECTANCE
                )
            more["reflectance"] = seen - TYPICAL_REFLECTANCE
        output, of_parts = self.unet(torch.cat((classical.maps, self.ray_maps(len(observed))), 1), more)
        features, weights, moved, logits = output.float().split(self.outputs, 1)
        shares = (4 * weights + self.preferred).softmax(1)
        v = (shares * classical.candidates).sum(1) + 0.3 * moved[:, 0]
        return_logits = (2 * logits[:, 0] + 1.5).clamp(-LOGIT_BOUND, LOGIT_BOUND)
        v = v.clamp(*self.limits_v)
        class_logits, reflectance, own = None, None, slice(self.sensor.height)
        if indices is not None:
            alone, trust = of_parts["labels"].float().split([NUM_CLASSES, NUM_LABELS], 1)
            class_logits = 2 * alone + _VOTE * votes(indices, self._shares(trust, classical.candidates[:, LABELLED], v))
            class_logits = class_logits[:, :, own]
        if self.config.reflectance and seen is not None:
            alone, trust = of_parts["reflectance"].float().split([1, NUM_REFLECTANCES], 1)
            reflectance = alone[:, 0] + (seen * self._shares(trust, classical.candidates[:, REFLECTING], v)).sum(1)
            reflectance = reflectance[:, own]
        guide = Guide(features, v.detach(), return_logits.detach(), observed)
        return CompletionOutput(guide, v[:, own], return_logits[:, own], class_logits, reflectance)

    def _shares(
        self, trust: Float[Tensor, "B S H W"], candidates: Float[Tensor, "B S H W"], v: Float[Tensor, "B H W"]
    ) -> Float[Tensor, "B S H W"]:
        """Return the shares of what is known at candidates of the range, of which the first is preferred at first.

        At first those on the surface on which the range lies are preferred, too.
        """
        apart = (candidates - v.detach()[:, None]).abs()
        return (4 * trust + self.preferred[: trust.shape[1]] - apart / _ONE_SURFACE).softmax(1)

    def sample(self, condition: Observed, rngs: Sequence[torch.Generator]) -> RangeImage:
        """Return completed scans: the range estimated, the mask sampled; a scan does not depend on the others.

        The range is the mean of two estimates, of the scan and of its mirror image, and so are the reflectance and the
        logits of classes. A scan gets reflectance and labels if it has some and the network has learned them.
        """
        images, uniform = [], self.mask.uniform(rngs)
        for index in range(len(rngs)):
            one = condition[index : index + 1]
            learned = {"label": self.config.labels, "reflectance": self.config.reflectance}  # others need no features
            shown = replace(one, planes={name: pixels for name, pixels in one.planes.items() if learned.get(name)})
            classical = classical_features(shown)
            point, mirrored = (
                self(classical, one.return_observed),
                self(classical.mirrored(), one.return_observed.flip(-1)),
            )
            v = (point.v + mirrored.v.flip(-1)) / 2
            mask = self.mask.sample(point.guide, uniform[index : index + 1], self.padded_condition(one))
            mask = mask[:, : self.sensor.height]
            low_m, high_m = condition.sensor.range_min_m, condition.sensor.range_max_m
            planes = dict[str, Tensor]()
            if classical.labels is not None and point.class_logits is not None and mirrored.class_logits is not None:
                planes["label"] = labels_of((point.class_logits + mirrored.class_logits.flip(-1)).argmax(1) + 1)
            if (
                classical.reflectances is not None
                and point.reflectance is not None
                and mirrored.reflectance is not None
            ):
                planes["reflectance"] = ((point.reflectance + mirrored.reflectance.flip(-1)) / 2).clamp(0, 1)
            range_m = v.expm1().clamp(low_m, high_m)
            images.append(RangeImage.masked(range_m, mask, condition.sensor, planes))
        return RangeImage.cat(images)

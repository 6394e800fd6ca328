"""Pixels generated in phases from coarse to fine, with exact probabilities: output of a decoder → range images."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from lidargrit.core.errors import ConfigError
from lidargrit.core.typed_values import Bounds, Temperature, Weight
from lidargrit.generation.any_sensor import RayNetwork
from lidargrit.generation.facts import SamplingSettings
from lidargrit.generation.pixel_decoder.mask_network import MaskNetwork
from lidargrit.generation.pixel_decoder.phase_network import Guide, PixelDecoderConfig
from lidargrit.generation.pixel_decoder.pixel_phases import Lattice, Phase, at_phases, join_phases, one_of_phases
from lidargrit.generation.pixel_decoder.range_network import RangeNetwork
from lidargrit.generation.range_steps import RangeSteps
from lidargrit.nn.collectives import num_processes, sum_over_processes
from lidargrit.nn.precision import Precision, autocast_to
from lidargrit.nn.random import of_host
from lidargrit.scans.condition import Observed
from lidargrit.scans.planes import planes_of
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import Decoded, RangeImage

# By lattice: the guide's part of the first layers, of both networks.
_Guided = tuple[dict[Lattice, Tensor], dict[Lattice, Tensor]]

_ALL_PHASES_AREA = 16  # training counts all phases of lattices with one in so many pixels, or fewer

_NOISE_AT_MOST = 1e6  # beyond, the components' scales have no finite numbers; with 100 all ranges are noise already

_EVEN = 0.4999  # in place of a random number: what is as likely as not returns

BITS_STEP_M = 0.01  # bits of a return are those of naming its range to a centimetre


@dataclass(frozen=True, kw_only=True)
class PixelSampling(SamplingSettings):
    """Settings of sampling masks, and ranges from their mixtures.

    By default samples are sharper than the mixtures themselves, which are ragged where a surface is uncertain. Only
    pixels that are sampled with temperatures and noise of 1 and a correlation of 0 follow the distribution, given the
    tokens, whose likelihood the model computes.

    Args:
        range_temperature: temperature of the mixture's density on one surface; 1 leaves it unchanged, below 1 prefers
            the densest of the components there. Surfaces that lie apart keep their probabilities. 0 takes the model's
            own temperature (``model.pixels.range_temperature``).
        surface_temperature: temperature of the choice between surfaces that lie apart; 1 leaves it unchanged, below 1
            prefers the more probable one. 0 takes the model's own (``model.pixels.surface_temperature``).
        mask_temperature: temperature of returns that are neither rare nor nearly certain; 1 leaves them unchanged,
            below 1 prefers the more probable, so that windows are closed. Drops by chance keep their probability. 0
            takes the model's own (``model.pixels.mask_temperature``).
        range_noise: multiplier of the components' scales; 1 takes them as they are.
        mask_correlation: multiplier of how much of their noise close pixels of a mask share that are sampled at once,
            so that drops cluster; 1 takes what was learned in training, 0 samples them independently.
        precision: number type of the networks' products. ``fp32`` is exact; ``bf16`` is quicker and moves some pixels;
            ``auto`` is ``bf16`` where the machine has instructions for it; ``tf32`` rounds what a GPU multiplies to 11
            digits.
        point: whether nothing is left to chance: pixels return that probably do, at the median range.
    """

    range_temperature: Temperature = 0.0
    surface_temperature: Temperature = 0.0
    mask_temperature: Temperature = 0.0
    range_noise: Annotated[float, Bounds(above=0, most=_NOISE_AT_MOST)] = 0.7
    mask_correlation: Weight = 2.0
    precision: Precision = "fp32"
    point: bool = False


class PixelNll(NamedTuple):
    """Negative log-likelihood of every pixel in nats.

    Args:
        mask: negative log-likelihood of the mask (a return or none), given the earlier pixels.
        range: negative log-likelihood of the range, given the whole mask and the earlier ranges; 0 without a return. It
            is that of a step where ranges have steps, and otherwise of a density per metre.
    """

    mask: Float[Tensor, "B H W"]
    range: Float[Tensor, "B H W"]


class PixelDecoder(RayNetwork):
    """Mask and range of every pixel, phase by phase, each phase given all earlier ones.

    Reflectance is not sampled: it is the mean that the tokenizer's decoder gives, if it gives one.

    First comes the whole mask, one Bernoulli number a pixel, then the range of what returned, from a mixture that may
    stand on either side of an edge. The pixels of one phase are independent of one another, given the earlier ones, but
    for the noise that their masks may share (:class:`PhaseNoise`).

    Args:
        features: number of channels of the tokenizer's features; 0 for a decoder without a tokenizer.
        components: number of components of the distribution of a range that the tokenizer decodes.
        gaps: whether what is decoded tells ranges of some pixels only, and 0 metres of the others.

    Source:
        Reed et al., Parallel Multiscale Autoregressive Density Estimation, 2017: phases from coarse to fine.
    """

    def __init__(
        self, config: PixelDecoderConfig, sensor: SensorModel, features: int, components: int = 1, gaps: bool = False
    ) -> None:
        super().__init__(sensor, config.any_sensor)
        if not config.any_sensor:
            _check_size(config, sensor)
        elif features and self.grid is not sensor:
            got = f"any_sensor=true for images of {sensor.height} rows, behind a tokenizer or the past"
            raise ConfigError(got, "rows in multiples of 16 there", "leave model.pixels.any_sensor out")
        self.config, self._sizes = config, (features, components, gaps)
        self.mask = MaskNetwork(config, self.grid, features, sensor.height)
        decoded = components if config.decoded_components and features else 0
        self.range = RangeNetwork(config, self.grid, features, decoded, gaps, sensor.height)

    def made_for(self, sensor: SensorModel) -> "PixelDecoder":
        """Return a new decoder of the same sizes for another sensor."""
        return PixelDecoder(self.config, sensor, *self._sizes)

    def forward(self, decoded: Decoded | None, images: RangeImage, steps: RangeSteps | None = None) -> PixelNll:
        """Return the exact negative log-likelihood of every pixel, given what was decoded from the tokens.

        Args:
            decoded: output of the tokenizer's decoder; None without a tokenizer.
            images: range images, rounded to the steps if there are any.
            steps: steps whose probability is the likelihood of a range; without them it is a density per metre.
        """
        guide, images = self.guide(decoded, len(images)), self._whole(images)
        guided = self.mask.guided(guide), self.range.guided(guide)
        mask_nll, range_nll = None, None  # of the pixels of a lattice, from the coarsest to the whole image
        for phases in self.mask.by_lattice():
            of_mask, of_range = self._nll(phases, guided, guide, images, steps)
            mask_nll, range_nll = join_phases(mask_nll, of_mask), join_phases(range_nll, of_range)
        assert mask_nll is not None
        assert range_nll is not None
        return PixelNll(mask_nll[:, : self.sensor.height], range_nll[:, : self.sensor.height])

    def guide(self, decoded: Decoded | None, count: int) -> Guide:
        """Return the inputs of the networks for every pixel of a number of scans before the first phase."""
        return Guide.nothing(self.mask.before, count, self.grid) if decoded is None else Guide.of(decoded)

    def expected(self, decoded: Decoded | None, images: RangeImage, steps: RangeSteps) -> PixelNll:
        """Return the expected value of :meth:`forward` for each pixel (its entropy), given the earlier ones."""
        guide, images = self.guide(decoded, len(images)), self._whole(images)
        guided = self.mask.guided(guide), self.range.guided(guide)
        mask, v = images.return_mask, images.range_m.log1p()
        mask_nats, range_nats = None, None
        for phases in self.mask.by_lattice():
            logits = self.mask.logits(phases, guided[0], guide, mask)
            # H(p) = ln(1 + e^z) - z p of the logit z
            mask_nats = join_phases(mask_nats, F.softplus(logits) - logits * logits.sigmoid())
            entropy = self.range.distributions(phases, guided[1], guide, mask, v).entropy(steps)
            range_nats = join_phases(range_nats, torch.where(at_phases(mask, phases), entropy, 0.0))
        assert mask_nats is not None
        assert range_nats is not None
        return PixelNll(mask_nats[:, : self.sensor.height], range_nats[:, : self.sensor.height])

    def _whole(self, images: RangeImage) -> RangeImage:
        """Return images with the absent rows, in which nothing returns."""
        return images if self.grid is self.sensor else images.mapped(self.padded, self.grid)

    def bits(
        self, decoded: Decoded | None, images: RangeImage, steps: RangeSteps, expected: bool
    ) -> tuple[Float[Tensor, "B H W"], Float[Tensor, "B H W"], Float[Tensor, "B H W"] | None]:
        """Return the bits of :meth:`forward` for mask and range, and those of :meth:`expected` together if asked for.

        They are what :class:`~lidargrit.scans.bits.ScanBits` has of every pixel.
        """
        mask, range_ = (nats / math.log(2) for nats in self(decoded, images, steps))
        if not expected:
            return mask, range_, None
        usual = self.expected(decoded, images, steps)
        return mask, range_, (usual.mask + usual.range) / math.log(2)

    def estimate(
        self, decoded: Decoded | None, images: RangeImage, rng: torch.Generator
    ) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
        """Return the mean nats of the mask a pixel and of the range a return, estimated by some of the phases.

        Of a fine lattice one phase counts for all: a step costs a third to a half, and there are as many more steps.
        Coarse lattices have few pixels to learn from, and all their phases count. The estimate of the mask is unbiased.
        """
        pixels, images = images.range_m.numel(), self._whole(images)
        guide = self.guide(decoded, len(images))
        known_m, host = images.range_m, of_host(rng)
        if self.training and self.config.own_context:
            known_m = self._partly_own(guide, images, rng, host)
        guided = self.mask.guided(guide), self.range.guided(guide)
        mask_nats, range_nats = guide.v.new_zeros(()), guide.v.new_zeros(())
        returns = guide.v.new_zeros(())
        for phases in self.mask.by_lattice():
            chosen = one_of_phases(phases, host) if phases[0].lattice.area < _ALL_PHASES_AREA else phases
            of_mask, of_range = self._nll(chosen, guided, guide, images, known_m=known_m)
            share = len(phases) / len(chosen)
            mask_nats = mask_nats + share * of_mask.sum()
            range_nats = range_nats + share * of_range.sum()
            returns = returns + share * at_phases(images.return_mask, chosen).sum()
        if self.training:  # the mean over processes of part / mean is the sum of the parts over that of the returns
            returns = sum_over_processes(returns) / num_processes()
        return mask_nats / pixels, range_nats / returns.clamp(min=1)

    @property
    def num_evaluations(self) -> int:
        """Number of passes through a network, one after the other, for one scan."""
        return len(self.mask.phases) + len(self.range.phases)

    def flops(self) -> int:
        """Return the floating-point operations of sampling one scan."""
        return self.mask.flops() + self.range.flops()

    def _nll(
        self,
        phases: list[Phase],
        guided: _Guided,
        guide: Guide,
        images: RangeImage,
        steps: RangeSteps | None = None,
        known_m: Float[Tensor, "B H W"] | None = None,
    ) -> tuple[Float[Tensor, "P B h w"], Float[Tensor, "P B h w"]]:
        """Return the nats of mask and range, given the ranges of the scans, or others in their place."""
        mask, v = images.return_mask, (images.range_m if known_m is None else known_m).log1p()
        returned = at_phases(mask, phases)
        of_mask = self.mask.phase_nll(phases, guided[0], guide, mask)
        # Where nothing returned, any range within the limits stands in: its likelihood is not used.
        range_m = torch.where(returned, at_phases(images.range_m, phases), self.sensor.range_min_m)
        mixture = self.range.distributions(phases, guided[1], guide, mask, v)
        if steps is None:
            likelihood = mixture.log_density(range_m)
        else:
            likelihood = mixture.log_mass(*steps.edges_m(steps.indices(range_m))).float()
        return of_mask, torch.where(returned, -likelihood, 0.0)

    @torch.no_grad()
    def _partly_own(
        self, guide: Guide, images: RangeImage, rng: torch.Generator, host: torch.Generator
    ) -> Float[Tensor, "B H W"]:
        """Return the ranges of scans, those of a random share of them sampled within the true masks."""
        device, size = guide.v.device, (len(images), 2, *guide.v.shape[1:])
        uniform = torch.rand(size, generator=rng, device=rng.device).to(device)
        chance = torch.rand((), generator=host, device="cpu")
        count = int(len(images) * self.config.own_context + float(chance))
        if not count:
            return images.range_m
        condition = self.padded_condition(Observed.nothing(self.sensor, count, device))
        own = guide.part(slice(0, count)), uniform[:count], images.return_mask[:count]
        return torch.cat((self._sample_range(*own, condition, PixelSampling()), images.range_m[count:]))

    def sample(
        self,
        decoded: Decoded | None,
        rngs: Sequence[torch.Generator],
        sampling: PixelSampling | None = None,
        condition: Observed | None = None,
    ) -> RangeImage:
        """Return one scan for each random generator; a scan does not depend on the others of its batch.

        Args:
            decoded: output of the tokenizer's decoder for as many scans, or on a CPU for more, of which the last are
                left out; None without a tokenizer.
            condition: observed part of the scans; nothing if not given. Observed returns and ranges are kept as they
                are when their phase comes: later phases know of them, earlier ones do not.
        """
        guide, size = self.guide(decoded, len(rngs)), (3, self.grid.height, self.grid.width)
        choices = sampling or PixelSampling()
        of_mask = choices.mask_temperature or self.config.mask_temperature
        uniform = torch.stack([torch.rand(size, generator=rng) for rng in rngs])
        shares = self.mask.noise.shares(choices.mask_correlation)
        for numbers, rng in zip(uniform, rngs, strict=True):
            numbers[0] = _EVEN if choices.point else self.mask.noise(numbers[0], rng, shares)
        device = guide.v.device
        uniform = uniform.to(device)
        condition = condition.to(device) if condition else Observed.nothing(self.sensor, len(rngs), device)
        condition = self.padded_condition(condition)
        # One scan after the other on a CPU: with other batch sizes its sums have other rounding errors.
        step = 1 if device.type == "cpu" else len(uniform)
        images = []
        for first in range(0, len(uniform), step):
            part = slice(first, first + step)
            some = guide.part(part)
            with autocast_to(choices.precision, device):
                mask = self.mask.sample(some, uniform[part, 0], condition[part], of_mask)
                range_m = self._sample_range(some, uniform[part, 1:], mask, condition[part], choices)
            reflectance = None if decoded is None or decoded.reflectance is None else decoded.reflectance[part]
            own = slice(self.sensor.height)
            planes = planes_of(reflectance=reflectance)
            images.append(RangeImage.masked(range_m[:, own], mask[:, own], self.sensor, planes))
        return RangeImage.cat(images)

    def _sample_range(
        self,
        guide: Guide,
        uniform: Float[Tensor, "B 2 H W"],
        mask: Bool[Tensor, "B H W"],
        condition: Observed,
        sampling: PixelSampling,
    ) -> Float[Tensor, "B H W"]:
        """Return the ranges of a whole mask, sampled phase by phase around the observed ones."""
        temperature = sampling.range_temperature or self.config.range_temperature
        of_surfaces = sampling.surface_temperature or self.config.surface_temperature
        guided = self.range.guided(guide)
        range_m, v = torch.zeros_like(guide.v), torch.zeros_like(guide.v)
        for phase in self.range.phases:
            pixels = (..., *phase.pixels)
            mixture = self.range.distributions([phase], guided, guide, mask, v)
            if self.config.any_sensor and (temperature, of_surfaces) != (1, 1):
                mixture = mixture.without_last()  # which is any range at all
            # Of every pixel, though some are observed and some do not return: the host need not know which.
            component, within = uniform[pixels][None].unbind(2)
            if sampling.point:
                sampled = mixture.median()[0]
            else:
                sampled = mixture.sample(component, within, temperature, sampling.range_noise, of_surfaces)[0]
            found = torch.where(condition.range_observed[pixels], condition.range_m[pixels], sampled)
            range_m[pixels] = found.where(mask[pixels], 0.0)
            v[pixels] = range_m[pixels].log1p()
        return range_m


def _check_size(config: PixelDecoderConfig, sensor: SensorModel) -> None:
    """Refuse images that the cells of one sensor do not divide."""
    rows, columns = (config.coarsest_cell * 2**halvings for halvings in (config.row_halvings, config.column_halvings))
    if sensor.height % rows or sensor.width % columns:
        raise ConfigError(
            f"range images of {sensor.height}x{sensor.width} for a pixel decoder of cells of {rows}x{columns}",
            "cells that divide both sides",
            "lower coarsest_cell, column_halvings or row_halvings, or choose another number of columns",
        )


def nats_to_range_bits(nats: Float[Tensor, "*P"]) -> Float[Tensor, "*P"]:
    """Return the bits of naming a range to :data:`BITS_STEP_M`, from the negative log-density per metre in nats."""
    return (nats - math.log(BITS_STEP_M)) / math.log(2)

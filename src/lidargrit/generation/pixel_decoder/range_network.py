"""The network of the distributions of ranges: masks and known ranges → mixtures, phase by phase."""

import math

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from lidargrit.generation.pixel_decoder.phase_network import Guide, PhaseNetwork, PixelDecoderConfig
from lidargrit.generation.pixel_decoder.pixel_phases import Lattice, Phase, at_phases, cells_of, pixels_around
from lidargrit.generation.pixel_decoder.range_candidates import RangeCandidates
from lidargrit.generation.pixel_decoder.range_mixture import SURFACE_V, RangeMixture
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import TYPICAL_LOG_RANGE

_FREE_COMPONENTS = 4  # of a range's distribution, begin at the decoded range; others begin at neighbours
_DECODED_HEAD_START = 4.0  # of the logits of decoded components: before training they are nearly all there is
_UNEXPECTED = 1e-4  # probability of any range at all, by a network for any sensor: its bits have a bound
_UNIFORM_LOG_SCALE = 1.0  # of such a range, in v: nearly flat between the limits
_LEAST_AGREEMENT = 1e-3  # what the decoded distribution rules out may be right all the same
_NEAR_V = 0.01  # a difference in v that is half of a large one: a hundredth of the range
_FINEST_M, _COARSEST_M = math.exp(-6), math.exp(4)  # scales of a component: 2.5 mm to 55 m


class RangeNetwork(PhaseNetwork):
    """The distribution of a range, given the whole mask and the ranges of earlier pixels.

    Its components are free, or begin at what the neighbours suggest: at an edge the range may be that of either side.
    Where nothing tells what to expect of a pixel, the mean of its neighbours stands in.

    Args:
        gaps: whether the guide tells ranges of some pixels only; without features it tells none.
    """

    def __init__(
        self,
        config: PixelDecoderConfig,
        sensor: SensorModel,
        features: int,
        decoded: int,
        gaps: bool,
        num_rows: int,
    ) -> None:
        phases = config.phases(sensor)
        suggest = RangeCandidates(sensor, phases, config.surface_components, config.gravity_components)
        self.has_gaps, self.is_told = gaps or not features, gaps
        added = self.has_gaps + (4 + decoded) * self.is_told
        self.context_channels = 4 * 3 + suggest.count + suggest.distances + added
        components = _FREE_COMPONENTS + suggest.count + decoded
        widths = (config.range_width, config.coarse_range_width or config.range_width)
        super().__init__(config, sensor, features, config.range_features, widths, 3 * components, num_rows)
        self.suggest, self.decoded, self.any_sensor = suggest, decoded, config.any_sensor
        self.weighs = config.weighed_components
        self.limits_m = (sensor.range_min_m, sensor.range_max_m)
        spread = torch.linspace(-0.2, 0.2, _FREE_COMPONENTS)
        scale = torch.cat((torch.zeros(_FREE_COMPONENTS), torch.full((suggest.count,), -2.0), torch.zeros(decoded)))
        self.register_buffer("begin", spread[:, None, None], persistent=False)
        self.register_buffer("begin_scale", scale[:, None, None], persistent=False)

    begin: Tensor
    begin_scale: Tensor

    def distributions(
        self,
        phases: list[Phase],
        guided: dict[Lattice, Tensor],
        guide: Guide,
        return_mask: Bool[Tensor, "B H W"],
        v: Float[Tensor, "B H W"],
    ) -> RangeMixture:
        """Return the distributions of the ranges at phases of one lattice; later ranges have no influence."""
        candidates = self.candidates(phases, guide, return_mask, v)
        decoded = None
        if self.decoded and guide.components is not None:
            decoded = torch.stack([guide.components[(..., *phase.pixels)] for phase in phases])
        contexts = self.context(phases, guide, return_mask, v, candidates, decoded)
        output = self.outputs(phases, guided, contexts)
        told = None if guide.told is None else at_phases(guide.told, phases)
        return self.mixture(output, candidates, decoded, told)

    def context(
        self,
        phases: list[Phase],
        guide: Guide,
        return_mask: Bool[Tensor, "B H W"],
        v: Float[Tensor, "B H W"],
        candidates: Float[Tensor, "P B K h w"],
        decoded: Float[Tensor, "P B 3 N h w"] | None = None,
    ) -> Float[Tensor, "P B D h w"]:
        """Return the mask, the known ranges beside the decoded ones, and how far the candidates are apart."""
        candidates, expected = candidates[:, :, :-1], candidates[:, :, -1:]
        maps = cells_of(torch.stack((return_mask.to(v.dtype), v - guide.v), 1), phases[0].lattice)
        returned, beside = maps.chunk(2, 1)
        generated = self.generated_before(phases) * returned
        apart = self.suggest.differences(candidates.flatten(0, 1)).unflatten(0, candidates.shape[:2])
        dropped = (1 - returned).expand_as(generated)
        parts = [generated, dropped, generated * beside, (candidates - expected).clamp(-2, 2), apart]
        if self.has_gaps:
            here = cells_of(guide.v[:, None], phases[0].lattice)
            parts[2] = generated * (beside - (expected - here)).clamp(-2, 2)
            parts.append(expected - TYPICAL_LOG_RANGE)
        if self.is_told and guide.told is not None:
            told = cells_of(guide.told[:, None].to(v.dtype), phases[0].lattice)
            parts.append(generated * told * bounded_difference(beside))
            if decoded is not None:
                from_expected = bounded_difference(decoded[:, :, 1] - expected)
                parts.append(at_phases(guide.told, phases)[:, :, None] * from_expected)
        return torch.cat(parts, 2)

    def candidates(
        self, phases: list[Phase], guide: Guide, return_mask: Bool[Tensor, "B H W"], v: Float[Tensor, "B H W"]
    ) -> Float[Tensor, "P B K h w"]:
        """Return what neighbours suggest, as ln(1 + range), and last what is expected without them.

        Expected is the decoded range, or where the guide tells none the mean of the neighbours.
        """
        return torch.stack([self._candidates(phase, guide, return_mask, v) for phase in phases])

    def _candidates(
        self, phase: Phase, guide: Guide, return_mask: Bool[Tensor, "B H W"], v: Float[Tensor, "B H W"]
    ) -> Float[Tensor, "B K h w"]:
        expected = guide.v[(..., *phase.pixels)]
        if self.has_gaps and phase.rank:
            near, known = pixels_around(phase, v, return_mask, phase.neighbours)
            count, total = known.sum(1), torch.where(known, near, 0.0).sum(1)
            open_ = count > 0 if guide.told is None else (count > 0) & ~guide.told[(..., *phase.pixels)]
            expected = torch.where(open_, total / count.clamp(min=1), expected)
        return torch.cat((self.suggest(phase, v, return_mask, expected), expected[:, None]), 1)

    def mixture(
        self,
        output: Float[Tensor, "P B O h w"],
        candidates: Float[Tensor, "P B K h w"],
        decoded: Float[Tensor, "P B 3 D h w"] | None,
        told: Bool[Tensor, "P B h w"] | None,
    ) -> RangeMixture:
        """Return the distributions of the ranges of the pixels of phases of one lattice.

        Args:
            output: output of the network: logits, how far the centres move, and the scales.
            candidates: suggestions of the neighbours, and last the range that is expected without them.
            decoded: components of the decoded distribution, if the network corrects any.
            told: True where something was decoded; None if it was everywhere.
        """
        logits, moved, scales = output.chunk(3, 2)
        free = candidates[:, :, -1:] + 2 * (moved[:, :, :_FREE_COMPONENTS] + self.begin)
        centres = [free, candidates[:, :, :-1]]
        scales = 1.5 * (scales + self.begin_scale)
        if decoded is not None:
            own_logits, own_centres, own_log_scales = decoded.unbind(2)
            centres.append(own_centres)
            logits = logits + F.pad(own_logits + _DECODED_HEAD_START, (0, 0, 0, 0, logits.shape[2] - self.decoded, 0))
            scales = scales + F.pad(own_log_scales + own_centres, (0, 0, 0, 0, scales.shape[2] - self.decoded, 0))
        anchored = torch.cat(centres[1:], 2) + 0.1 * moved[:, :, _FREE_COMPONENTS:]
        low, high = (math.log1p(limit) for limit in self.limits_m)
        centres = torch.cat((free, anchored), 2).clamp(low, high)
        if self.weighs and decoded is not None:
            agreement = _agreement(centres[:, :, : -self.decoded], decoded)
            agreement = agreement if told is None else agreement * told[:, :, None]
            logits = logits + F.pad(agreement, (0, 0, 0, 0, 0, self.decoded))
        log_scales_m = scales.clamp(math.log(_FINEST_M), math.log(_COARSEST_M))
        log_scales = log_scales_m - centres  # dv = d range / (1 + range): so the scale is one in metres
        if self.any_sensor:
            any_range = logits.logsumexp(2, keepdim=True) + math.log(_UNEXPECTED)
            logits = torch.cat((logits, any_range), 2)
            centres = torch.cat((centres, torch.full_like(any_range, (low + high) / 2)), 2)
            log_scales = torch.cat((log_scales, torch.full_like(any_range, _UNIFORM_LOG_SCALE)), 2)
        logits, centres, log_scales = (part.movedim(2, -1).contiguous() for part in (logits, centres, log_scales))
        return RangeMixture(logits, centres, log_scales, self.limits_m)


def _agreement(around: Float[Tensor, "P B K h w"], decoded: Float[Tensor, "P B 3 D h w"]) -> Float[Tensor, "P B K h w"]:
    """Return the logarithm of the probability that a decoded distribution gives to ranges near each centre."""
    logits, centres, log_scales = (part[:, :, None] for part in decoded.unbind(2))
    inverse = (-log_scales).exp()
    distance, half = (around[:, :, :, None] - centres) * inverse, SURFACE_V * inverse
    near = (distance + half).sigmoid() - (distance - half).sigmoid()
    return ((logits.softmax(3) * near).sum(3) + _LEAST_AGREEMENT).log()


def bounded_difference(apart: Float[Tensor, "*P"]) -> Float[Tensor, "*P"]:
    """Return differences in v between -1 and 1, so that small ones are told apart."""
    return apart / (apart.abs() + _NEAR_V)

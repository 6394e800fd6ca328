"""A mixture of logistic distributions of a range, cut off at the sensor's limits: numbers → density, random ranges."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from numpy.polynomial.legendre import leggauss
from torch import Tensor

from lidargrit.generation.range_steps import RangeSteps
from lidargrit.nn.random import sample_index

# Quantiles and their shares in a mean. At the ends of a logistic distribution -ln of its density has no bound, so nodes
# are dense there: u = s^2 (3 - 2s) of Gauss-Legendre's s.
_NODES = tuple(
    (s * s * (3 - 2 * s), 3 * s * (1 - s) * float(weight))
    for s, weight in (((1 + float(at)) / 2, weight) for at, weight in zip(*leggauss(8), strict=True))
)
SURFACE_V = 0.1  # half the width of a surface in v: a tenth of its range
_LARGEST_EXPONENT = 80.0  # its exponential stays finite in 32 bits
_PAIRS_ON_CPU, _PAIRS_ON_GPU = 1 << 17, 1 << 28  # at once: half a megabyte, in the cache, and a gigabyte
_LEAST_MASS = 1e-6  # of a component within the limits; the logarithm stays finite


@dataclass(frozen=True)
class RangeMixture:
    """The distribution of v = ln(1 + range in metres) of one pixel, for many pixels.

    Every component is cut off at the limits and rescaled, so that ranges of the sensor have probability 1 together.

    Args:
        logits: logits of the components' weights.
        centres: centres of the components, in v, within the limits.
        log_scales: natural logarithm of the components' scales, in v.
        limits_m: shortest and longest range of the sensor in metres.

    Source:
        Salimans et al., PixelCNN++, 2017, section 2.1: a mixture of logistics; there of bins, here of a density.
    """

    logits: Float[Tensor, "*P K"]
    centres: Float[Tensor, "*P K"]
    log_scales: Float[Tensor, "*P K"]
    limits_m: tuple[float, float]

    def at(self, pixels: Bool[Tensor, "*P"]) -> "RangeMixture":
        """Return the distributions of some pixels, one after the other."""
        return RangeMixture(self.logits[pixels], self.centres[pixels], self.log_scales[pixels], self.limits_m)

    def without_last(self) -> "RangeMixture":
        """Return the distributions of all components but the last."""
        logits, centres, log_scales = (part[..., :-1] for part in (self.logits, self.centres, self.log_scales))
        return RangeMixture(logits, centres, log_scales, self.limits_m)

    def log_density(self, range_m: Float[Tensor, "*P"]) -> Float[Tensor, "*P"]:
        """Return the natural logarithm of the probability density per metre."""
        v = range_m.log1p()[..., None]
        z = (v - self.centres) * (-self.log_scales).exp()
        # The logistic density is sigmoid'(z) / scale, and ln sigmoid'(z) = -z - 2 softplus(-z).
        component = -z - 2 * F.softplus(-z) - self.log_scales - self._mass().clamp(min=_LEAST_MASS).log()
        weighted = self.logits.log_softmax(-1) + component
        return weighted.logsumexp(-1) - v[..., 0]  # dv / d range = 1 / (1 + range) = exp(-v)

    def log_mass(self, low_m: Float[Tensor, "*P"], high_m: Float[Tensor, "*P"]) -> Float[Tensor, "*P"]:
        """Return the natural logarithm of the probability of a range between two ranges within the limits.

        It is computed from the width of the interval, so that it is exact where the interval holds next to nothing.
        """
        inverse = (-self.log_scales).exp()
        below = (low_m.log1p()[..., None] - self.centres) * inverse
        width = ((high_m - low_m) / (1 + low_m)).log1p()[..., None] * inverse  # dv = ln((1 + high) / (1 + low))
        # s(b) - s(a) = s(b) s(-a) (1 - exp(a - b)) of the logistic function s.
        component = F.logsigmoid(below + width) + F.logsigmoid(-below) + (-(-width).expm1()).log()
        weighted = self.logits.log_softmax(-1) + component - self._mass().clamp(min=_LEAST_MASS).log()
        return weighted.logsumexp(-1)

    def mode(self) -> Float[Tensor, "*P"]:
        """Return the range in metres at whose component's centre the density is the highest."""
        densest = self._by_pairs(_Pairs.log_density).argmax(-1, keepdim=True)
        return self.centres.gather(-1, densest)[..., 0].expm1()

    def median(self) -> Float[Tensor, "*P"]:
        """Return in metres the centre of the component in whose order by range half of the probability is reached."""
        order = self.centres.argsort(-1)
        reached = self.logits.softmax(-1).gather(-1, order).cumsum(-1) >= 0.5 - 1e-6  # their sum may miss 1
        half = order.gather(-1, reached.int().argmax(-1, keepdim=True))
        return self.centres.gather(-1, half)[..., 0].expm1()

    def entropy(self, steps: RangeSteps) -> Float[Tensor, "*P"]:
        """Return the expected -ln of the probability of a step, by Gauss-Legendre quadrature over the quantiles of
        every component."""
        low, mass = self._bounds()[0], self._mass()
        total = torch.zeros_like(self.centres[..., 0])
        weights = self.logits.softmax(-1)
        for quantile, share in _NODES:
            level = (low + quantile * mass).clamp(1e-6, 1 - 1e-6)
            v = self.centres + self.log_scales.exp() * level.logit()
            for component in range(v.shape[-1]):
                edges_m = steps.edges_m(steps.indices(v[..., component].expm1()))
                nats = -self.log_mass(*edges_m).to(total.dtype)
                total = total + weights[..., component] * nats * share
        return total

    def sample(
        self,
        component: Float[Tensor, "*P"],
        within: Float[Tensor, "*P"],
        temperature: float = 1.0,
        noise: float = 1.0,
        surface_temperature: float = 1.0,
    ) -> Float[Tensor, "*P"]:
        """Return one range in metres for each pixel.

        Args:
            component: uniform random numbers in [0, 1) that choose a component.
            within: uniform random numbers in [0, 1) that choose a range of the component.
            temperature: temperature of the density on one surface; 1 leaves it unchanged, below 1 prefers the densest
                of the components there. Surfaces that lie apart keep their probabilities.
            noise: multiplier of the components' scales.
            surface_temperature: temperature of the choice between surfaces that lie apart; below 1 prefers the more
                probable one.
        """
        scaled = RangeMixture(
            self._tempered_logits(temperature, surface_temperature),
            self.centres,
            self.log_scales + torch.tensor(noise, dtype=self.log_scales.dtype).log(),
            self.limits_m,
        )
        chosen = sample_index(scaled.logits, component)[..., None]
        low, high = (bound.gather(-1, chosen)[..., 0].double() for bound in scaled._bounds())
        centre = scaled.centres.gather(-1, chosen)[..., 0].double()
        scale = scaled.log_scales.gather(-1, chosen)[..., 0].double().exp()
        level = (low + within.double() * (high - low)).clamp(1e-9, 1 - 1e-9)
        return (centre + scale * level.logit()).expm1().clamp(*self.limits_m).float()

    def _tempered_logits(self, temperature: float, surface_temperature: float) -> Float[Tensor, "*P K"]:
        """Return the logits of the components' weights at a temperature T of the density on each surface.

        The surface of a component is what lies within ``SURFACE_V`` of its centre. The component's weight is
        multiplied by d^(1/T - 1) of the density d at its centre, and divided by the mean of that power over the
        surface: over all components, each counted by its probability there, cut-offs left out. So components compete
        with those that reach the same surface: a pole loses little to the wall behind it, and only where it is so broad
        that the wall lies within its spread. A temperature of the whole density would take half of all poles away.

        At a temperature S of the surfaces the weight is multiplied by m^(1/S - 1) besides, where m is the probability
        of the component's surface.
        """
        if temperature == surface_temperature == 1:
            return self.logits

        def log_correction(pairs: "_Pairs") -> Tensor:
            power = pairs.log_density().mul_(1 / temperature - 1)
            there = pairs.mass_near_centres()
            log_mass = _finite_log(there.sum(0))
            by_power = (power.T[..., None] - power).clamp_(max=_LARGEST_EXPONENT).exp_()
            return log_mass.div_(surface_temperature).sub_(_finite_log(there.mul_(by_power).sum(0)))

        return self.logits.log_softmax(-1) + self._by_pairs(log_correction)

    @torch.no_grad()
    def _by_pairs(self, compute: Callable[["_Pairs"], Tensor]) -> Float[Tensor, "*P K"]:
        """Return what a function computes from all pairs of components of some pixels, for all pixels."""
        log_weights, mass = self.logits.log_softmax(-1), self._mass().clamp(min=_LEAST_MASS)
        heights = (log_weights - self.log_scales - mass.log()).exp()
        parts = (self.centres, (-self.log_scales).exp(), heights, log_weights.exp())
        count = self.centres.shape[-1]
        at_once = max(1, (_PAIRS_ON_CPU if self.centres.device.type == "cpu" else _PAIRS_ON_GPU) // count**2)
        blocks = zip(*(part.reshape(-1, count).split(at_once) for part in parts), strict=True)
        return torch.cat([compute(_Pairs(*block)) for block in blocks]).view_as(self.centres)

    def _bounds(self) -> tuple[Float[Tensor, "*P K"], Float[Tensor, "*P K"]]:
        low, high = _log1p(self.limits_m)
        inverse = (-self.log_scales).exp()
        return ((low - self.centres) * inverse).sigmoid(), ((high - self.centres) * inverse).sigmoid()

    def _mass(self) -> Float[Tensor, "*P K"]:
        low, high = self._bounds()
        return high - low


class _Pairs:
    """All pairs of the components of some pixels: the other one first, then the pixel, then the one looked at.

    Args:
        centres: centres of the components.
        inverse: reciprocals of the components' scales.
        heights: weights of the components, divided by scale and by mass within the limits.
        weights: weights of the components.
    """

    def __init__(
        self,
        centres: Float[Tensor, "P K"],
        inverse: Float[Tensor, "P K"],
        heights: Float[Tensor, "P K"],
        weights: Float[Tensor, "P K"],
    ) -> None:
        others, self._steepness, self._heights, self._weights = (
            part.T[..., None] for part in (centres, inverse, heights, weights)
        )
        # The other's distance in its scales. A negative one keeps the digits of what is next to nothing.
        self._distance = (centres - others).abs_().mul_(-self._steepness)

    def log_density(self) -> Float[Tensor, "P K"]:
        s = self._distance.sigmoid()
        return _finite_log(s.addcmul_(s, s, value=-1).mul_(self._heights).sum(0))  # the logistic density: s (1 - s)

    def mass_near_centres(self) -> Float[Tensor, "K P K"]:
        """Return the probability of each other component within ``SURFACE_V`` of a component's centre."""
        half = SURFACE_V * self._steepness
        there = (self._distance + half).sigmoid_()
        return there.sub_((self._distance - half).sigmoid_()).mul_(self._weights)


def _finite_log(numbers: Float[Tensor, "*P"]) -> Float[Tensor, "*P"]:
    return numbers.clamp_(min=torch.finfo(numbers.dtype).tiny).log_()


@cache
def _log1p(limits_m: tuple[float, float]) -> list[float]:
    return torch.tensor(limits_m, device="cpu").log1p().tolist()  # a tensor would be copied to the device each time

"""Random numbers of a mask's pixels: independent ones → ones that are alike where pixels of one phase lie close."""

import math
from collections.abc import Sequence
from functools import lru_cache

import torch
from jaxtyping import Bool, Float, Float64
from torch import Tensor, nn

from lidargrit.generation.pixel_decoder.pixel_phases import Phase
from lidargrit.nn.collectives import sum_over_processes

_REACH = 0.6  # correlation of a shared part between a pixel and the next of its phase
_TERMS = 4  # of the series, whose error is below 2 % up to a correlation of 0.5
_HALF_LIFE_SCANS = 200  # of the sums of a phase, in scans of which it was taken
_PRIOR = 10.0  # as if about a hundred uncertain pairs had been seen without any correlation
_MOST = 0.9  # of the noise that is shared; the rest decides each pixel alone
_OF_NEXT_COLUMN = 0.6  # correlation with the numbers of the column before, where a scan is several images
_LEAST = 1e-6  # of a probability, so that its quantile is finite
ROW_RAD, COLUMN_RAD = math.radians(0.42), 2 * math.pi / 256
"""Distances of rows and columns at which noise of any sensor decays as that of its own pixels does."""


class PhaseNoise(nn.Module):
    """A Gaussian copula for the pixels of a phase, whose probabilities it leaves unchanged.

    The pixels of a phase are sampled at once, each with its probability given the earlier phases. In real scans they
    depend on one another beyond that: an edge between two known columns lies on the same side in many rows. So the
    normal number that decides a pixel is a sum of three: one of its own, one that pixels above one another have in
    common, and one that pixels beside one another have; the common ones decay with the distance. The shares are learned
    in training, from how the residuals of neighbours in one phase correlate.

    Args:
        phases: all phases of the pixel decoder.
        places: place of every row, and distance of two columns, in rows and columns of a typical sensor, by which the
            noise decays; one for each row and column if not given.
        sampled: those phases that sample the images at hand; all if not given. The others lie on the pixels of these.

    Source:
        Sklar's theorem for the copula; Kibble, An extension of a theorem of Mehler's on Hermite polynomials, 1945.
    """

    sums: Tensor

    def __init__(
        self,
        phases: Sequence[Phase],
        places: tuple[Sequence[float], float] | None = None,
        sampled: Sequence[Phase] | None = None,
    ) -> None:
        super().__init__()
        self.phases, self._given = tuple(phases), places
        self._sampled = frozenset(phases if sampled is None else sampled)
        # For each phase and direction (down, along the row): residuals' products, then the series' coefficients.
        self.register_buffer("sums", torch.zeros(len(phases), 2, 1 + _TERMS))

    @torch.no_grad()
    def learn(
        self, phases: Sequence[Phase], logits: Float[Tensor, "P B h w"], returned: Bool[Tensor, "P B h w"]
    ) -> None:
        """Take in the residuals of true masks.

        Args:
            phases: consecutive phases.
            logits: logits of the probability of a return, given the earlier phases; infinite for pixels to leave out.
            returned: True where a pixel returned.
        """
        seen = self.sums.new_zeros(*self.sums.shape[:2], 2 + _TERMS)  # the sums, then the number of scans
        factors = _hermite_factors(logits.detach().double(), returned)
        pairs = [(factors[..., :-1, :], factors[..., 1:, :])]
        if factors.shape[-1] > 1:  # one column alone would be its own neighbour
            pairs.append((factors, factors.roll(-1, -1)))
        first = self.phases.index(phases[0])
        for direction, (one, other) in enumerate(pairs):
            some, products = seen[first : first + len(phases), direction], one * other
            if self._given is not None:
                products = products * self._nearness(phases, direction, products)
            some[:, :-1] = products.sum((2, 3, 4)).T
            some[:, -1] = logits.shape[1]
        seen, scans = sum_over_processes(seen).split((1 + _TERMS, 1), -1)  # which may each have taken other phases
        kept = 0.5 ** ((seen[:, :, 1:2] > 0) * (scans / _HALF_LIFE_SCANS))
        self.sums.mul_(kept).add_(seen)

    def _nearness(
        self, phases: Sequence[Phase], direction: int, products: Float64[Tensor, "F P B h w"]
    ) -> Float64[Tensor, "F P 1 #h 1"]:
        """Return by how much each term of the covariance of neighbours is larger than at the typical distance."""
        rows = products.shape[3] + (direction == 0)
        apart = [
            torch.tensor(self._places(phase, (rows, 2))[direction], dtype=torch.float64).diff() for phase in phases
        ]
        nearness = _REACH ** (torch.stack(apart).abs().to(products.device) - 1)
        powers = torch.arange(len(products), device=products.device)[:, None, None]  # the residuals have none
        return (nearness**powers)[:, :, None, :, None]

    def _places(self, phase: Phase, size: tuple[int, int]) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the places of a phase's rows and columns, in steps from one to the next of a typical sensor."""
        if self._given is None:
            return tuple(map(float, range(size[0]))), tuple(map(float, range(size[1])))
        rows, step = self._given
        of_rows = tuple(row / (2 * phase.lattice.rows) for row in rows[phase.pixels[0]])
        return of_rows, tuple(step * column for column in range(size[1]))

    def correlations(self) -> Float64[Tensor, "phases 2"]:
        """Return the correlation of a pixel's normal number with that of the next of its phase, down and along."""
        sums = self.sums.double().cpu()
        low, high = torch.zeros(sums.shape[:2], dtype=sums.dtype), torch.full(sums.shape[:2], 0.99, dtype=sums.dtype)
        for _ in range(20):  # the series grows with the correlation
            middle = (low + high) / 2
            powers = torch.stack([middle**term for term in range(1, 1 + _TERMS)], -1)
            below = (sums[..., 1:] * powers).sum(-1) + _PRIOR * middle < sums[..., 0]
            low, high = torch.where(below, middle, low), torch.where(below, high, middle)
        return low

    def shares(self, strength: float = 1.0) -> Float64[Tensor, "phases 2"]:
        """Return the variance that pixels of a phase share down a column, and along a row.

        Args:
            strength: multiplier of the shares, whose sum stays below 1.
        """
        shares = strength * self.correlations() / _REACH
        return shares * (_MOST / shares.sum(-1, keepdim=True).clamp(min=_MOST))

    def forward(
        self, uniform: Float[Tensor, "H W"], rng: torch.Generator, shares: Float64[Tensor, "phases 2"]
    ) -> Float[Tensor, "H W"]:
        """Return uniform numbers in [0, 1) of the same image, correlated within each phase and not between phases.

        Args:
            uniform: independent random numbers in [0, 1).
            rng: source of the shared parts, on the CPU.
            shares: shares of every phase; if all are 0 the numbers stay as they are.
        """
        if not bool(shares.any()):
            return uniform
        shared = torch.randn((2, *uniform.shape), generator=rng, dtype=torch.float64)
        normal = torch.special.ndtri(uniform.double().clamp(_LEAST, 1 - _LEAST))
        for phase, (down, along) in zip(self.phases, shares.tolist(), strict=True):
            if phase not in self._sampled:
                continue
            own, rows, columns = normal[phase.pixels], shared[0][phase.pixels], shared[1][phase.pixels]
            of_rows, of_columns = self._places(phase, (own.shape[0], own.shape[1]))
            mixed = math.sqrt(1 - down - along) * own
            mixed = mixed + math.sqrt(down) * (_root(of_rows) @ rows)
            normal[phase.pixels] = mixed + math.sqrt(along) * (columns @ _root(of_columns, wraps=True).T)
        return torch.special.ndtr(normal).to(uniform.dtype).clamp(max=1 - torch.finfo(uniform.dtype).eps)


def following(own: Float[Tensor, "H W"], before: Sequence[Float[Tensor, "H W"]]) -> Float[Tensor, "H W"]:
    """Return uniform numbers of an image that correlate with those of the images of the columns before.

    The normal numbers of neighbouring columns are an autoregression, whose distribution in each image is that of its
    own numbers.

    Args:
        own: numbers in [0, 1) of the image.
        before: numbers of the earlier images, the nearest last, each drawn without regard to the others.
    """
    if not before:
        return own
    normal, *later = (torch.special.ndtri(one.double().clamp(_LEAST, 1 - _LEAST)) for one in (*before, own))
    for one in later:
        normal = _OF_NEXT_COLUMN * normal + math.sqrt(1 - _OF_NEXT_COLUMN**2) * one
    return torch.special.ndtr(normal).to(own.dtype).clamp(max=1 - torch.finfo(own.dtype).eps)


def _hermite_factors(logits: Float64[Tensor, "*P"], returned: Bool[Tensor, "*P"]) -> Float64[Tensor, "F *P"]:
    """Return the residuals, and one factor of each term of the covariance of two of them; 0 for pixels left out.

    For thresholds s and t of two normal numbers of correlation r it is the sum over k of r^k / k! times the product of
    the factors He_{k-1}(s) phi(s) and He_{k-1}(t) phi(t), with Hermite's polynomials He and the normal density phi.
    """
    counted = logits.isfinite()
    probability = torch.where(counted, logits, 0.0).sigmoid()
    residual = torch.where(counted, returned.double() - probability, 0.0)
    threshold = torch.special.ndtri(probability.clamp(_LEAST, 1 - _LEAST))
    density = torch.where(counted, (-0.5 * threshold.square()).exp() / math.sqrt(2 * math.pi), 0.0)
    polynomials = [torch.ones_like(threshold), threshold]
    for degree in range(1, _TERMS - 1):
        polynomials.append(threshold * polynomials[-1] - degree * polynomials[-2])
    terms = [each * density / math.sqrt(math.factorial(term)) for term, each in enumerate(polynomials, start=1)]
    return torch.stack([residual, *terms])


@lru_cache(maxsize=64)
def _root(places: tuple[float, ...], wraps: bool = False) -> Float64[Tensor, "n n"]:
    """Return the Cholesky factor of correlations that decay with the distance, on a line or around a circle.

    Args:
        places: places of the pixels; around a circle they are equally far apart.
    """
    at = torch.tensor(places, dtype=torch.float64)
    apart = (at[:, None] - at).abs()
    if wraps:
        step = places[1] - places[0] if len(places) > 1 else 1
        apart = torch.minimum(apart, len(places) * step - apart)
    return torch.linalg.cholesky(_REACH**apart)

"""The network of the return mask: which earlier pixels returned → logits of a return of the next phase's."""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from lidargrit.generation.any_sensor import RayNetwork
from lidargrit.generation.pixel_decoder.phase_network import Guide, PhaseNetwork, PixelDecoderConfig
from lidargrit.generation.pixel_decoder.phase_noise import COLUMN_RAD, ROW_RAD, PhaseNoise, following
from lidargrit.generation.pixel_decoder.pixel_phases import Lattice, Phase, at_phases, cells_of, one_of_phases
from lidargrit.nn.random import of_host, rngs_of
from lidargrit.scans.condition import Observed
from lidargrit.scans.sensors import SensorModel

_NEVER = -60.0  # logit of a return in rows that a sensor does not have

_BY_CHANCE = 0.1  # returns and drops that are rarer come by chance; others belong to a surface


class MaskNetwork(PhaseNetwork):
    """The logits of P(return), given which of the earlier pixels returned: a correction of the decoder's logits."""

    context_channels = 4 * 2

    def __init__(self, config: PixelDecoderConfig, sensor: SensorModel, features: int, num_rows: int) -> None:
        widths = config.mask_width, config.mask_width
        super().__init__(config, sensor, features, config.mask_features, widths, 1, num_rows)
        self.row_bias = (
            nn.Linear(config.row_channels, 1) if config.any_sensor else nn.Parameter(torch.zeros(sensor.height))
        )
        places = None
        if config.any_sensor:
            rows = (sensor.elevation_rad.double().mean(1) / -ROW_RAD).tolist()
            places = rows, 2 * math.pi / sensor.width / COLUMN_RAD
        self.noise = PhaseNoise(self._learned, places, self.phases)

    @classmethod
    def behind(cls, features: int, width: int, network: RayNetwork) -> "MaskNetwork":
        """Return a network that samples masks behind another network than a tokenizer's decoder, all of whose features
        it sees.

        Args:
            features: channels of the other network's features.
            width: channels of the layers.
            network: the other network, which tells the sensor, and whether it is any.
        """
        config = PixelDecoderConfig(mask_features=features, mask_width=width, any_sensor=network.any_sensor)
        return cls(config, network.grid, features, network.sensor.height)

    def context(
        self, phases: list[Phase], guide: Guide, return_mask: Bool[Tensor, "B H W"]
    ) -> Float[Tensor, "P B D h w"]:
        """Return for each pixel of a cell whether it is known to have returned, and whether it is known not to.

        Later pixels have no influence.
        """
        lattice = phases[0].lattice
        returned = cells_of(return_mask[:, None].to(guide.v.dtype), lattice)
        certain = self.generated_before(phases)
        if guide.observed is not None:
            certain = torch.maximum(certain, cells_of(guide.observed[:, None].to(guide.v.dtype), lattice))
        return torch.cat((certain * returned, certain * (1 - returned)), 2)

    def uniform(
        self, rngs: Sequence[torch.Generator], earlier_seeds: Int64[Tensor, "B K"] | None = None
    ) -> Float[Tensor, "B H W"]:
        """Return random numbers for one mask of each generator, correlated as learned, on the device of the network.

        Args:
            earlier_seeds: seeds of images whose columns lie before those of each image, the nearest last, and -1 for
                none; their numbers then correlate with its own.
        """
        shares = self.noise.shares()

        def of(rng: torch.Generator) -> Float[Tensor, "H W"]:
            return self.noise(torch.rand((self.sensor.height, self.sensor.width), generator=rng), rng, shares)

        numbers = [of(rng) for rng in rngs]
        if earlier_seeds is not None:
            every = [[seed for seed in seeds if seed >= 0] for seeds in earlier_seeds.tolist()]
            seeds = sorted({seed for some in every for seed in some})  # images of one scan share them
            drawn = {seed: of(rng) for seed, rng in zip(seeds, rngs_of(seeds), strict=True)}
            numbers = [following(own, [drawn[seed] for seed in some]) for own, some in zip(numbers, every, strict=True)]
        return torch.stack(numbers).to(self.before.device)

    def sample(
        self, guide: Guide, uniform: Float[Tensor, "B H W"], condition: Observed, temperature: float = 1.0
    ) -> Bool[Tensor, "B H W"]:
        """Return the mask, sampled phase by phase around its observed pixels.

        Args:
            guide: output of the decoder for every pixel.
            uniform: random numbers in [0, 1): independent ones, or those that ``noise`` makes of them.
            temperature: temperature of returns that are neither rare nor nearly certain; 1 leaves them unchanged.
        """
        guided = self.guided(guide)
        mask = condition.return_mask & condition.return_observed
        for phase in self.phases:
            pixels = (..., *phase.pixels)
            sampled = uniform[pixels] < tempered(self.logits([phase], guided, guide, mask)[0].sigmoid(), temperature)
            mask[pixels] = torch.where(condition.return_observed[pixels], mask[pixels], sampled)
        return mask

    def logits(
        self, phases: list[Phase], guided: dict[Lattice, Tensor], guide: Guide, return_mask: Bool[Tensor, "B H W"]
    ) -> Float[Tensor, "P B h w"]:
        """Return the logits of the pixels of phases of one lattice; later pixels of the mask have no influence."""
        output = self.outputs(phases, guided, self.context(phases, guide, return_mask))
        decoded = guide.return_logits + self.row_biases(phases[0].lattice)[:, None]
        return output[:, :, 0] + at_phases(decoded, phases)

    def row_biases(self, lattice: Lattice) -> Float[Tensor, "H"]:
        """Return what is added to the logits of all rows; absent ones never return."""
        if not isinstance(self.row_bias, nn.Linear):
            return self.row_bias
        own = self.row_bias(self.row_values(lattice).T)[: self.num_rows, 0]
        return F.pad(own, (0, self.sensor.height - self.num_rows), value=_NEVER)

    def phase_nll(
        self, phases: list[Phase], guided: dict[Lattice, Tensor], guide: Guide, returned: Bool[Tensor, "B H W"]
    ) -> Float[Tensor, "P B h w"]:
        """Return the negative log-likelihood in nats of the pixels of phases of one lattice, 0 for observed ones.

        In training the noise learns from them how pixels of one phase depend on one another.
        """
        logits = self.logits(phases, guided, guide, returned)
        truth = at_phases(returned, phases)
        nll = F.binary_cross_entropy_with_logits(logits, truth.float(), reduction="none")
        known = None if guide.observed is None else at_phases(guide.observed, phases)
        if self.training:
            self.noise.learn(phases, logits if known is None else logits.masked_fill(known, torch.inf), truth)
        return nll if known is None else nll * ~known

    def nats(
        self, guide: Guide, returned: Bool[Tensor, "B H W"], rng: torch.Generator | None = None
    ) -> Float[Tensor, " B"]:
        """Return the negative log-likelihood of the unknown part of each mask in nats.

        Args:
            guide: output of a decoder for every pixel, and what is known before the first phase.
            returned: true masks.
            rng: chooses one phase of each lattice, which stands for all; every phase is counted without it.
        """
        guided, total = self.guided(guide), guide.v.new_zeros(len(returned))
        rng = None if rng is None else of_host(rng)
        for phases in self.by_lattice():
            chosen = phases if rng is None else one_of_phases(phases, rng)
            nll = self.phase_nll(chosen, guided, guide, returned)
            total = total + nll.sum((0, 2, 3)) * (len(phases) / len(chosen))
        return total


def tempered(probability: Float[Tensor, "*P"], temperature: float) -> Float[Tensor, "*P"]:
    """Return probabilities of a return, sharper between a tenth and nine tenths where the temperature is below 1.

    Rarer drops and returns keep their probability: a temperature of all would take the drops that come by chance away.
    """
    if temperature == 1:
        return probability
    width = 1 - 2 * _BY_CHANCE
    share = (probability - _BY_CHANCE) / width
    sharper = _BY_CHANCE + width * (share.clamp(0, 1).logit() / temperature).sigmoid()
    return torch.where((share > 0) & (share < 1), sharper, probability)

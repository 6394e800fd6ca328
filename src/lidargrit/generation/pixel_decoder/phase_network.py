"""What the mask's and the range's network of a pixel decoder share: sizes, what guides them, a network a lattice."""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from lidargrit.core.configuration import Settings
from lidargrit.core.errors import ConfigError
from lidargrit.core.typed_values import Bounds, Count, NotNegative, Share
from lidargrit.core.untrusted import TEMPERATURE_AT_LEAST
from lidargrit.generation.pixel_decoder.pixel_phases import Lattice, Phase, cells_of, generated_before, phases_of
from lidargrit.generation.pixel_decoder.ray_encoding import LEAST_CELL, RowEncoding, coarsest_cell_of
from lidargrit.nn.blocks import Network, zeroed
from lidargrit.nn.convolution import Convolution, Residual
from lidargrit.nn.precision import at_least_32_bits
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import TYPICAL_LOG_RANGE, Decoded

LOGIT_BOUND = 8.0  # of the decoder's return logits, beyond which it is as good as sure
_HALVINGS_AT_MOST = 8  # of one side alone
_COARSE_AREA = 64  # lattices with one in so many pixels, or fewer, are coarse
_DECODED_LOG_SCALE_M = -3.0  # 5 cm


@dataclass(frozen=True)
class PixelDecoderConfig(Settings):
    """Sizes of the pixel decoder.

    Args:
        coarsest_cell: shorter side of the cells of which the first phase generates one pixel each; a power of 2. Cells
            divide both sides of the image.
        column_halvings: number of halvings of the distance between columns alone, which come last, so that pixels know
            of others in their own row; cells have as many columns as rows, times 2 for each.
        row_halvings: number of halvings of the distance between rows alone, which come last, so that pixels know of
            others in their own column, for images whose columns are farther apart than their rows; cells have as many
            rows as columns, times 2 for each. It is 0 if column_halvings is not.
        mask_features: number of channels of the tokenizer's features that the mask network sees, if any.
        range_features: number of channels of the tokenizer's features that the range network sees, if any.
        row_channels: number of learned values of every row.
        mask_width: number of channels of the mask network's layers.
        range_width: number of channels of the range network's layers.
        coarse_range_width: number of channels of the range network's layers of lattices with one in 64 pixels or
            fewer; 0 for ``range_width``. Channels cost little there, and coarse ranges decide how straight walls are.
        blocks: number of residual blocks of each network.
        surface_components: whether 8 more components begin on planes and straight lines through neighbours, so that the
            surfaces on both sides of an edge are continued.
        gravity_components: whether 8 more components begin on vertical planes through two earlier pixels and on
            horizontal ones through a neighbour, so that walls and the ground are continued from fewer pixels. They
            assume that the sensor is level.
        decoded_components: whether more components are those of the range's distribution that the tokenizer decodes,
            or one at its decoded range where it decodes no distribution; they are corrected as the mask's logits are.
        weighed_components: whether all other components are weighed by the probability that the decoded distribution
            gives to ranges near them, so that a wall does not take pixels of a pole; needs ``decoded_components``.
        own_context: share of the scans of training whose earlier ranges the decoder samples itself; beside true ones
            alone it learns to rely on neighbours more than on the tokens, and samples drift. It doubles the time, and
            roughens walls unless a training beside true ones follows.
        any_sensor: whether the networks are told the angles of each row, by a small perceptron, in place of values that
            are learned row by row, so that the weights serve every spinning sensor; ``coarsest_cell`` is then the
            largest, and smaller images begin with smaller cells.
        range_temperature: temperature of ranges on one surface where the caller names none. What suits a model depends
            on its columns and its training: choose it by samples against validation scans.
        surface_temperature: temperature of the choice between surfaces where the caller names none. Below 1 edges of
            objects are less ragged; where the tokenizer tells little of thin objects, more of these are lost.
        mask_temperature: temperature of returns that are neither rare nor nearly certain, where the caller names none.
            Below 1 windows are closed, and drops cluster more.
    """

    coarsest_cell: Count = 8
    column_halvings: Annotated[int, Bounds(0, _HALVINGS_AT_MOST)] = 0
    row_halvings: Annotated[int, Bounds(0, _HALVINGS_AT_MOST)] = 0
    mask_features: Count = 12
    range_features: Count = 12
    row_channels: Count = 4
    mask_width: Count = 32
    range_width: Count = 48
    coarse_range_width: NotNegative = 0
    blocks: Count = 2
    surface_components: bool = False
    gravity_components: bool = False
    decoded_components: bool = False
    weighed_components: bool = False
    own_context: Share = 0.0
    any_sensor: bool = False
    range_temperature: Annotated[float, Bounds(TEMPERATURE_AT_LEAST)] = 0.35
    surface_temperature: Annotated[float, Bounds(TEMPERATURE_AT_LEAST)] = 1.0
    mask_temperature: Annotated[float, Bounds(TEMPERATURE_AT_LEAST)] = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        phases_of(self.coarsest_cell, self.column_halvings, self.row_halvings)
        if self.weighed_components and not self.decoded_components:
            raise ConfigError("weighed_components without decoded_components", "both", "set decoded_components=true")
        if self.any_sensor and (self.column_halvings or self.row_halvings):
            got = f"any_sensor with column_halvings={self.column_halvings} and row_halvings={self.row_halvings}"
            raise ConfigError(got, "square cells, which all sensors share", "leave them out, or any_sensor")

    def phases(self, sensor: SensorModel) -> list[Phase]:
        """Return the phases of a sensor's images."""
        cell = coarsest_cell_of(sensor, self.coarsest_cell) if self.any_sensor else self.coarsest_cell
        return phases_of(cell, self.column_halvings, self.row_halvings)

    def learned_phases(self) -> list[Phase]:
        """Return the phases of all images that the networks know: any large lattice may be some sensor's first."""
        phases = phases_of(self.coarsest_cell, self.column_halvings, self.row_halvings)
        if not self.any_sensor or self.coarsest_cell <= LEAST_CELL:
            return phases
        lattices = dict.fromkeys(phase.lattice for phase in phases)
        return [Phase(each, *at) for each in lattices for at in each.order]


class Guide(NamedTuple):
    """Output of a tokenizer's decoder for every pixel; without a tokenizer, the same numbers for all pixels.

    Args:
        features: features of the decoder's last layer; none without a tokenizer.
        v: ln(1 + decoded range in metres).
        return_logits: logits of the probability of a return, bounded.
        observed: True where it was observed whether there is a return; None if nothing was observed.
        components: logits, centres and log scales of the components of the decoded distribution of v; a single one at
            ``v`` if only that is decoded.
        told: True where ``v`` is told of a pixel; None if it is of all.
    """

    features: Float[Tensor, "B C H W"]
    v: Float[Tensor, "B H W"]
    return_logits: Float[Tensor, "B H W"]
    observed: Bool[Tensor, "B H W"] | None = None
    components: Float[Tensor, "B 3 K H W"] | None = None
    told: Bool[Tensor, "B H W"] | None = None

    def part(self, some: slice) -> "Guide":
        """Return the guide of some of the scans."""
        others = (None if each is None else each[some] for each in (self.observed, self.components, self.told))
        return Guide(self.features[some], self.v[some], self.return_logits[some], *others)

    @classmethod
    def of(cls, decoded: Decoded) -> "Guide":
        """Return the guide from the output of the tokenizer's decoder."""
        if decoded.features is None:
            raise ConfigError(
                "a tokenizer whose decoder gives no features",
                "one that gives them (Decoded.features)",
                "leave the pixel decoder out, or choose the tokenizer vqvae",
            )
        logits = at_least_32_bits(decoded.return_logits).clamp(-LOGIT_BOUND, LOGIT_BOUND)
        told = decoded.range_m > 0
        v = at_least_32_bits(decoded.range_m).log1p().where(told, TYPICAL_LOG_RANGE)
        components = decoded.components
        if components is None:
            components = torch.stack((torch.zeros_like(v), v, _DECODED_LOG_SCALE_M - v), 1)[:, :, None]
        return cls(at_least_32_bits(decoded.features), v, logits, None, at_least_32_bits(components), told)

    @classmethod
    def nothing(cls, like: Tensor, count: int, sensor: SensorModel) -> "Guide":
        """Return the guide of scans of which no token tells anything, as numbers of the type of another tensor."""
        size = (count, sensor.height, sensor.width)
        return cls(like.new_zeros(count, 0, *size[1:]), like.new_full(size, TYPICAL_LOG_RANGE), like.new_zeros(size))


class LatticeNetwork(Network):
    """The network of all phases of one lattice, over cells of 2x2 pixels of the lattice.

    The part of the first layer that sees the guide is computed once for all phases.
    """

    def __init__(self, guide: int, context: int, width: int, blocks: int, phases: int, outputs: int) -> None:
        super().__init__()
        self.guide, self.context = Convolution(guide, width, "wrap"), Convolution(context, width, "wrap")
        self.phase_bias = nn.Parameter(torch.zeros(phases, width))
        self.blocks = nn.Sequential(*(Residual(width) for _ in range(blocks)))
        self.out = zeroed(nn.ModuleList(nn.Conv2d(width, outputs, 1) for _ in range(phases)))

    def forward(
        self, guided: Float[Tensor, "B C h w"], contexts: Float[Tensor, "P B D h w"], first: int
    ) -> Float[Tensor, "P B O h w"]:
        """Return the outputs of as many phases as there are contexts, from the phase ``first`` on."""
        size = contexts.shape[:2]
        x = self.context(contexts.flatten(0, 1)).unflatten(0, size)
        x = x + guided + self.phase_bias[first : first + size[0], None, :, None, None]
        x = F.silu(self.blocks(x.flatten(0, 1))).unflatten(0, size)
        outputs = [layer(part) for layer, part in zip(self.out[first:], x, strict=False)]
        return at_least_32_bits(torch.stack(outputs))


class PhaseNetwork(nn.Module):
    """Base of the mask's and the range's network: a small network for each lattice, run anew for every phase.

    Args:
        kept: number of channels of the tokenizer's features that it sees.
        sensor: sensor of the images, with absent rows if there are any.
        num_rows: number of the sensor's own rows; the others are absent.
    """

    def __init__(
        self,
        config: PixelDecoderConfig,
        sensor: SensorModel,
        features: int,
        kept: int,
        widths: tuple[int, int],
        outputs: int,
        num_rows: int,
    ) -> None:
        super().__init__()
        self.phases, self._learned = config.phases(sensor), config.learned_phases()
        self.sensor, self.num_rows = sensor, num_rows
        kept = kept if features else 0
        self.features = nn.Conv2d(features, kept, 1) if features else nn.Identity()
        self.rows = self._rows(config)
        guide = 4 * (kept + config.row_channels + 2)
        self.networks = nn.ModuleDict()
        for phases in _by_lattice(self._learned):
            lattice = phases[0].lattice
            width = widths[lattice.area >= _COARSE_AREA]
            network = LatticeNetwork(guide, self.context_channels, width, config.blocks, len(phases), outputs)
            self.networks[lattice.name] = network
        self.register_buffer("before", generated_before(self.phases), persistent=False)

    before: Tensor
    context_channels: int

    def _rows(self, config: PixelDecoderConfig) -> nn.Parameter | RowEncoding:
        if not config.any_sensor:
            return nn.Parameter(torch.zeros(config.row_channels, self.sensor.height))
        lattices = list(dict.fromkeys(phase.lattice for phase in self.phases))
        return RowEncoding(config.row_channels, self.sensor, self.num_rows, lattices)

    def row_values(self, lattice: Lattice) -> Float[Tensor, "C H"]:
        """Return the values of all rows, learned one by one or told by their angles."""
        return self.rows(lattice) if isinstance(self.rows, RowEncoding) else self.rows

    def guided(self, guide: Guide) -> dict[Lattice, Tensor]:
        """Return the first layer's output for the guide, (B, C, h, w), by lattice, the same for all phases."""
        count, columns = len(guide.v), guide.v.shape[-1]
        decoded = torch.stack((guide.v - TYPICAL_LOG_RANGE, guide.return_logits / 4), 1)
        features, first_layers = self.features(guide.features), {}
        for lattice, network in self._networks():
            rows = self.row_values(lattice)[None, :, :, None].expand(count, -1, -1, columns)
            first_layers[lattice] = network.guide(cells_of(torch.cat((features, rows, decoded), 1), lattice))
        return first_layers

    def outputs(
        self, phases: list[Phase], guided: dict[Lattice, Tensor], contexts: Float[Tensor, "P B D h w"]
    ) -> Float[Tensor, "P B O h w"]:
        """Return the network's outputs for consecutive phases of one lattice, from what is known before each."""
        lattice = phases[0].lattice
        first = [phase for phase in self._learned if phase.lattice == lattice].index(phases[0])
        return self.networks[lattice.name](guided[lattice], contexts, first)

    def generated_before(self, phases: list[Phase]) -> Float[Tensor, "P 1 4 1 1"]:
        """Return 1 for those of the 2x2 pixels that are generated before consecutive phases', and 0 for others."""
        first = self.phases.index(phases[0])
        return self.before[first : first + len(phases)]

    def flops(self) -> int:
        """Return the floating-point operations of all phases of one scan: two for each multiplication and addition."""
        pixels = self.sensor.height * self.sensor.width
        total = 2 * pixels * sum(weight.numel() for weight in self.features.parameters() if weight.ndim == 4)
        for (lattice, network), phases in zip(self._networks(), self.by_lattice(), strict=True):
            outputs = list(network.out)[-len(phases) :]
            once = network.guide.weight.numel() + sum(layer.get_parameter("weight").numel() for layer in outputs)
            each = sum(weight.numel() for weight in network.blocks.parameters() if weight.ndim == 4)
            each += network.context.weight.numel()
            total += 2 * (pixels // (4 * lattice.area)) * (once + len(outputs) * each)
        return total

    def by_lattice(self) -> list[list[Phase]]:
        """Return the phases, those of one lattice together."""
        return _by_lattice(self.phases)

    def _networks(self) -> list[tuple[Lattice, LatticeNetwork]]:
        networks = [(phases[0].lattice, self.networks[phases[0].lattice.name]) for phases in self.by_lattice()]
        return [(lattice, network) for lattice, network in networks if isinstance(network, LatticeNetwork)]


def _by_lattice(phases: list[Phase]) -> list[list[Phase]]:
    lattices = dict.fromkeys(phase.lattice for phase in phases)
    return [[phase for phase in phases if phase.lattice == lattice] for lattice in lattices]

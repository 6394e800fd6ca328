"""Networks that are told a sensor's rays: one set of weights → the images of any sensor, of any number of rows."""

from abc import ABC, abstractmethod
from typing import Self, TypeVar

import torch
import torch.nn.functional as F
from jaxtyping import Float, Shaped
from torch import Tensor, nn

from lidargrit.generation.objective import Objective
from lidargrit.generation.pixel_decoder.pixel_phases import Lattice
from lidargrit.generation.pixel_decoder.ray_encoding import RowEncoding, with_absent_rows
from lidargrit.nn.blocks import Block
from lidargrit.scans.condition import Observed
from lidargrit.scans.sensors import SensorModel, mean_azimuths_rad

_SENSORS_KEPT = 256  # whose rows are encoded, and whose surfaces are known
_EVERY_PIXEL = Lattice(1, 1)

ModuleT = TypeVar("ModuleT", bound=nn.Module)


class RayNetwork(nn.Module, ABC):
    """Base of networks that may be told the rays of each sensor, so that their weights serve the images of all.

    Such a network works on an image with absent rows, so that the number of rows is a multiple of 16; they hold no
    return, and what it computes of them is dropped.

    Args:
        sensor: sensor of the images.
        any_sensor: whether the network is told the rays; one that is not knows its own sensor alone.

    Attributes:
        grid: the sensor with its absent rows, if there are any.
    """

    azimuth: Tensor

    def __init__(self, sensor: SensorModel, any_sensor: bool) -> None:
        super().__init__()
        self.sensor, self.any_sensor = sensor, any_sensor
        self.grid = with_absent_rows(sensor) if any_sensor else sensor
        self._others: dict[SensorModel, Self] = {}

    @abstractmethod
    def made_for(self, sensor: SensorModel) -> Self:
        """Return a new network of the same sizes for another sensor."""

    def for_sensor(self, sensor: SensorModel) -> Self:
        """Return the network of another sensor's images with the very same weights: what one learns the other knows.

        A network that is not for any sensor returns itself. What is computed of a sensor's rays is kept.
        """
        if not self.any_sensor or sensor is self.sensor:
            return self
        device, found = next(self.buffers()).device, self._others.get(sensor)
        if found is None or next(found.buffers()).device != device:
            with torch.random.fork_rng(devices=[]):  # the weights that it begins with are not used
                found = sharing_weights(self.made_for(sensor).to(device), self)
            for other, own in zip(found.modules(), self.modules(), strict=True):
                if isinstance(other, Block) and isinstance(own, Block):
                    other.recomputed = own.recomputed
            if len(self._others) >= _SENSORS_KEPT:
                del self._others[next(iter(self._others))]
            self._others[sensor] = found
        return found.train(self.training)

    def padded(self, pixels: Shaped[Tensor, "*B H W"]) -> Shaped[Tensor, "*B G W"]:
        """Return maps of the sensor's pixels with the absent rows, in which all is 0."""
        absent = self.grid.height - self.sensor.height
        return F.pad(pixels, (0, 0, 0, absent)) if absent else pixels

    def padded_condition(self, condition: Observed) -> Observed:
        """Return what is known of scans with the absent rows, of which nothing is known."""
        if self.grid is self.sensor:
            return condition
        range_m, returned = self.padded(condition.range_m), self.padded(condition.return_mask)
        known = self.padded(condition.range_observed), self.padded(condition.return_observed)
        return Observed(range_m, known[0], returned, known[1], self.grid)

    def _tell_rays(self, row_channels: int) -> None:
        """Make the inputs of :meth:`ray_maps`: ``rows``, learned one by one or from the angles, and ``azimuth``."""
        if self.any_sensor:
            self.rows = RowEncoding(row_channels, self.grid, self.sensor.height, [_EVERY_PIXEL])
        else:
            self.rows = nn.Parameter(torch.zeros(row_channels, self.sensor.height))
        azimuth_rad = mean_azimuths_rad(self.sensor.azimuth_rad).float()
        self.register_buffer("azimuth", torch.stack((azimuth_rad.sin(), azimuth_rad.cos())), persistent=False)

    def ray_maps(self, count: int) -> Float[Tensor, "B C G W"]:
        """Return the values of every row, and the sine and cosine of every column's azimuth, as maps of some images."""
        rows = self.rows(_EVERY_PIXEL) if isinstance(self.rows, RowEncoding) else self.rows
        height, width = self.grid.height, self.grid.width
        of_rows = rows[None, :, :, None].expand(count, -1, -1, width)
        return torch.cat((of_rows, self.azimuth[None, :, None].expand(count, -1, height, -1)), 1)


class RayObjective(Objective):
    """Base of objectives of networks that may be told the rays, which then go on from one of a single sensor, too."""

    def weights_from(self, trained: Objective) -> dict[str, Tensor]:
        """Return the weights of a trained network, for any sensor without those of the rows of a single one."""
        weights = super().weights_from(trained)
        if not any(network.any_sensor for network in self.children() if isinstance(network, RayNetwork)):
            return weights
        own = self.state_dict()
        return {name: weight for name, weight in weights.items() if name in own}


def sharing_weights(made: ModuleT, trained: nn.Module) -> ModuleT:
    """Return a module whose weights are those of another one of the same sizes, the very same tensors."""
    for name, weight in trained.state_dict(keep_vars=True).items():
        module, _, last = name.rpartition(".")
        setattr(made.get_submodule(module), last, weight)
    return made

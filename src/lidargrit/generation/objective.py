"""What a stage of training minimises: (examples, random numbers) → the terms of a loss."""

from abc import ABC, abstractmethod

import torch
from jaxtyping import Shaped
from torch import Tensor, nn

from lidargrit.scans.example import Example
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage


class Objective(nn.Module, ABC):
    """A loss over batches of examples; its parameters are what the stage trains."""

    sensor: SensorModel
    players: tuple[str, ...] = ()
    """Names of the players of an adversarial objective, in their order; empty where there is one loss only.

    Every step asks the objective once for each player, and moves the weights that this player's loss reaches before it
    asks for the next. The objective itself keeps the other players' weights out of a player's reach.
    """
    reaches_all_weights: bool = True
    """Whether every step's loss has a gradient in every weight; several processes then need not look for those without.

    It is taken as false where there are players.
    """
    ray_buffers: tuple[str, ...] = ()
    """Names of buffers that hold the angles of the sensor's rays: they are not taken over from another sensor."""
    additions: frozenset[str] = frozenset()
    """Settings of the stage that, if true, add weights; training may start from a stage that lacks them."""
    settings: tuple[str, ...] = ()
    """Settings of the generator that it learns by, beside those that begin with the name of the stage."""
    kin: tuple[type["Objective"], ...] = ()
    """Other kinds from which :meth:`weights_from` takes what fits; training may start from a stage of theirs."""
    over: tuple[str, ...] = ()
    """Names of earlier stages whose networks compute what it learns from; it is of no use with other networks."""
    period: int = 1
    """Number of training steps after which the same operations come again; more than 1 if some terms come rarely."""

    keeps_encodings: bool = False
    """Whether it keeps what a frozen network makes of each image; images then come with keys (``Example.keys``)."""

    def __init__(self, sensor: SensorModel) -> None:
        super().__init__()
        self.sensor = sensor

    @abstractmethod
    def forward(self, example: Example, rng: torch.Generator, player: str = "") -> dict[str, Tensor]:
        """Return the terms of the loss as scalars: ``loss``, which is minimised, and beside it what is worth logging.

        Args:
            example: batch of range images with what is known of each.
            rng: random numbers, on the device of the images.
            player: one of ``players``; "" where there are none.
        """

    def check(self, images: RangeImage) -> None:
        """Refuse images without what the objective learns from, such as labels, before any stage is trained.

        Args:
            images: one of the training or validation images, as a batch.

        Raises:
            ConfigError: tells what the images lack.
        """
        return

    def preparation_flops(self, scans: int) -> int:
        """Return the floating-point operations of what is computed once, before steps learn from it.

        Args:
            scans: number of scans seen over the whole training.
        """
        return 0

    def weights_from(self, trained: "Objective") -> dict[str, Tensor]:
        """Return the weights of a trained objective of this kind in the shapes of this one's, where that is possible.

        Training goes on from them; weights that the trained one lacks keep the values that they have.
        """
        weights = dict(trained.state_dict())
        if not self.sensor.same_rays(trained.sensor):
            for name in self.ray_buffers:
                del weights[name]
        return weights

    def warnings(self) -> list[str]:
        """Return lines that a person should read after a validation, such as that a codebook has collapsed."""
        return []


def hidden_in_some(
    pixels: Shaped[Tensor, "B H W"], unknown: int | float, share: float, rng: torch.Generator
) -> Shaped[Tensor, "B H W"]:
    """Return the pixels of a batch, in some scans all of them unknown, so that a network learns to do without.

    Args:
        pixels: labels by SemanticKITTI's numbers, or reflectance.
        unknown: value of an unknown pixel.
        share: probability that a scan's pixels are hidden.
    """
    kept = torch.rand((len(pixels), 1, 1), generator=rng, device=rng.device) >= share
    return torch.where(kept.to(pixels.device), pixels, unknown)

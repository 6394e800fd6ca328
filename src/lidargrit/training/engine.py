"""The one file that knows Lightning Fabric: devices, processes and precision."""

from __future__ import annotations

import logging
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from lidargrit.structures import RangeImage


class Engine:
    """Runs an objective on this machine's device, in one process or in each of several under a launcher.

    Args:
        precision: ``fp32`` or ``bf16``.
    """

    def __init__(self, precision: Literal["fp32", "bf16"]) -> None:
        from lightning_fabric import Fabric  # noqa: PLC0415  takes a second, and only training needs it

        logging.getLogger("lightning_fabric").setLevel(logging.WARNING)  # it tells the precision at every start
        self._fabric: Any = Fabric(precision="bf16-mixed" if precision == "bf16" else "32-true")
        self._fabric.launch()
        self.device, self.rank, self.world_size = self._fabric.device, self._fabric.global_rank, self._fabric.world_size

    def set_up(self, objective: nn.Module, optimiser: torch.optim.Optimizer) -> None:
        """Place an objective on the device and spread it over the processes."""
        self._objective, self._optimiser = self._fabric.setup(_TensorDoor(objective), optimiser)

    def step(self, images: RangeImage, seed: int, gradient_clip: float) -> dict[str, Tensor]:
        """Take one step and return the objective's terms; no weight changes if the loss is not finite."""
        self._objective.train()
        terms = self._objective(images.range_m, images.return_mask, seed)
        if not bool(terms["loss"].isfinite()):
            return terms
        self._fabric.backward(terms["loss"])
        if gradient_clip:
            self._fabric.clip_gradients(self._objective, self._optimiser, max_norm=gradient_clip)
        self._optimiser.step()
        self._optimiser.zero_grad()
        return {name: term.detach() for name, term in terms.items()}

    def evaluate(self, objective: nn.Module, images: RangeImage, seed: int) -> dict[str, float]:
        """Return an objective's terms on a batch, in evaluation mode."""
        was_training = objective.training
        objective.eval()
        with torch.no_grad(), self._fabric.autocast():
            terms = objective(images.to(self.device), torch.Generator(self.device).manual_seed(seed))
        objective.train(was_training)
        return {name: float(term) for name, term in terms.items()}


class _TensorDoor(nn.Module):
    """Takes tensors and makes the range image inside, for the engine converts and scatters tensors only."""

    def __init__(self, objective: nn.Module) -> None:
        super().__init__()
        self.objective = objective
        self._sensor: Any = objective.sensor

    def forward(
        self, range_m: Float[Tensor, "B H W"], return_mask: Bool[Tensor, "B H W"], seed: int
    ) -> dict[str, Tensor]:
        rng = torch.Generator(range_m.device).manual_seed(seed)
        return self.objective(RangeImage(range_m, return_mask, self._sensor), rng)

"""The one file that knows Lightning Fabric: devices, processes and precision."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from lidargrit.nn.precision import Precision, dtype_of
from lidargrit.structures import RangeImage


class Engine:
    """Runs an objective on this machine's device, in one process or in each of several under a launcher.

    Args:
        precision: ``fp32``, ``bf16``, or ``auto`` for the second where the machine has instructions for it.
    """

    def __init__(self, precision: Precision) -> None:
        from lightning_fabric import Fabric  # noqa: PLC0415  takes a second, and only training needs it

        logging.getLogger("lightning_fabric").setLevel(logging.WARNING)  # it tells the precision at every start
        # One device, unless a launcher such as torchrun began this process as one of several.
        launched = "LOCAL_RANK" in os.environ
        short = dtype_of(precision) == torch.bfloat16
        self._fabric: Any = Fabric(precision="bf16-mixed" if short else "32-true", devices="auto" if launched else 1)
        self._fabric.launch()
        self.device, self.rank, self.world_size = self._fabric.device, self._fabric.global_rank, self._fabric.world_size

    def set_up(self, objective: nn.Module, optimiser: torch.optim.Optimizer) -> None:
        """Place an objective on the device and spread it over the processes."""
        self._objective, self._optimiser = self._fabric.setup(_Door(objective), optimiser)

    def step(self, images: RangeImage, seed: int, gradient_clip: float) -> dict[str, Tensor]:
        """Take one step, or one of each player in turn, and return the terms.

        No weight changes by a loss or a gradient that is not finite.
        """
        self._objective.train()
        terms: dict[str, Tensor] = {}
        for phase in _phases(self._objective.objective):
            found, is_finite = self._step(images, seed, gradient_clip, phase)
            terms = _joined(terms, found, phase)
            if not is_finite:
                break
        return terms

    def _step(self, images: RangeImage, seed: int, gradient_clip: float, phase: str) -> tuple[dict[str, Tensor], bool]:
        terms = self._objective(lambda: images, seed, phase)
        if not bool(terms["loss"].isfinite()):
            return terms, False
        self._fabric.backward(terms["loss"])
        if gradient_clip:
            norm = self._fabric.clip_gradients(
                self._objective, self._optimiser, max_norm=gradient_clip, error_if_nonfinite=False
            )
            if not bool(norm.isfinite()):
                return {**terms, "loss": norm}, False
        self._optimiser.step()
        self._optimiser.zero_grad()  # to None: the optimiser leaves alone what the next player does not move
        return {name: term.detach() for name, term in terms.items()}, True

    def evaluate(self, objective: nn.Module, images: RangeImage, seed: int) -> dict[str, float]:
        """Return an objective's terms on a batch, in evaluation mode."""
        was_training = objective.training
        objective.eval()
        terms: dict[str, Tensor] = {}
        with torch.no_grad(), self._fabric.autocast():
            for phase in _phases(objective):
                rng = torch.Generator(self.device).manual_seed(seed)
                terms = _joined(terms, _ask(objective, images.to(self.device), rng, phase), phase)
        objective.train(was_training)
        return {name: float(term) for name, term in terms.items()}


class _Door(nn.Module):
    """Takes a function that returns the images: the engine would round tensors, and so all ranges, to its precision."""

    def __init__(self, objective: nn.Module) -> None:
        super().__init__()
        self.objective = objective

    def forward(self, images: Callable[[], RangeImage], seed: int, phase: str) -> dict[str, Tensor]:
        device = next(self.objective.parameters()).device
        return _ask(self.objective, images(), torch.Generator(device).manual_seed(seed), phase)


def _phases(objective: nn.Module) -> tuple[str, ...]:
    """Return the names of an objective's players, who take turns; one without a name where it has none."""
    return getattr(objective, "phases", ("",))


def _ask(objective: nn.Module, images: RangeImage, rng: torch.Generator, phase: str) -> dict[str, Tensor]:
    return objective(images, rng, phase) if phase else objective(images, rng)


def _joined(terms: dict[str, Tensor], found: dict[str, Tensor], phase: str) -> dict[str, Tensor]:
    """Add a player's terms under its name to those of the players before it, and its loss to theirs."""
    if not phase:
        return found
    loss = found["loss"] + terms.get("loss", 0.0)
    return {**terms, "loss": loss, **{f"{phase}_{name}": term for name, term in found.items()}}

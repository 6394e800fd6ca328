"""Devices, processes and precision by Lightning Fabric; no other file imports it."""

import logging
import math
import os
import resource
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch.distributed import DistError

from lidargrit.core.determinism import derive_seed
from lidargrit.core.errors import ConfigError, LidarGritError, TrainingError
from lidargrit.core.processes import rank_and_world_size
from lidargrit.generation.objective import Objective
from lidargrit.nn.precision import Precision, dtype_of, products_in
from lidargrit.nn.size import within_memory
from lidargrit.scans.example import Example


class Engine:
    """Runs an objective on this machine's device, in one process or in each of several under a launcher.

    Attributes:
        sees_at_once: whether the host knows numbers as soon as they are computed, as on a CPU, and need not wait.

    Args:
        precision: number type of products; ``auto`` is ``bf16`` where the machine has instructions for it.
        reaches_all_weights: whether every loss has a gradient in every weight; otherwise, as in adversarial training,
            processes do not wait for gradients that do not come.
    """

    def __init__(self, precision: Precision, reaches_all_weights: bool = True) -> None:
        from lightning_fabric import Fabric  # noqa: PLC0415  takes a second, and only training needs it
        from lightning_fabric.plugins.environments.lightning import LightningEnvironment  # noqa: PLC0415
        from lightning_fabric.plugins.environments.torchelastic import TorchElasticEnvironment  # noqa: PLC0415
        from lightning_fabric.strategies.ddp import DDPStrategy  # noqa: PLC0415

        logging.getLogger("lightning_fabric").setLevel(logging.WARNING)  # it prints the precision at every start
        # One device, unless a launcher such as torchrun began this process as one of several.
        where: dict[str, Any] = {"devices": 1, "plugins": [LightningEnvironment()]}  # whatever a batch queue has set
        _, processes = rank_and_world_size(None, None)
        if processes > 1:
            if "LOCAL_RANK" not in os.environ:
                raise ConfigError(
                    f"WORLD_SIZE={processes} without LOCAL_RANK",
                    "a launcher that sets RANK, WORLD_SIZE and LOCAL_RANK, or none of them",
                    "begin with torchrun, or unset WORLD_SIZE and RANK",
                )
            here = int(os.environ.get("LOCAL_WORLD_SIZE", processes))
            strategy = DDPStrategy(find_unused_parameters=not reaches_all_weights)
            where = {"devices": here, "num_nodes": processes // here, "strategy": strategy}
            where["plugins"] = [TorchElasticEnvironment()]
        self._precision: Precision = precision
        short = dtype_of(precision) == torch.bfloat16
        self._fabric: Any = Fabric(precision="bf16-mixed" if short else "32-true", **where)
        self._fabric.launch()
        self.device, self.rank, self.world_size = self._fabric.device, self._fabric.global_rank, self._fabric.world_size
        self.sees_at_once = self.device.type == "cpu"
        self._finite = torch.ones((), dtype=torch.bool, device=self.device)

    def set_up(self, objective: Objective, optimiser: torch.optim.Optimizer) -> None:
        """Move an objective to the device, and synchronise its gradients over the processes."""
        self._objective, self._optimiser = self._fabric.setup(_UncastInputs(objective), optimiser)

    def by_first(self, action: Callable[[], None]) -> None:
        """Let only the first process do something, such as write a file; every process raises the error that it met."""
        error: LidarGritError | None = None
        if self.rank == 0:
            try:
                action()
            except LidarGritError as raised:
                error = raised
        if self.world_size > 1:
            error = self._fabric.broadcast(error)
        if error is not None:
            raise error

    @contextmanager
    def lost_processes_reported(self) -> Iterator[None]:
        """Report in one line that another process has died, whatever the library of the connection prints."""
        try:
            yield
        except RuntimeError as error:  # NCCL has a class of its own for it, gloo has not
            if self.world_size == 1 or not (isinstance(error, DistError) or "/gloo/" in str(error)):
                raise
            raise TrainingError(
                f"no answer from another of {self.world_size} processes",
                "all of them to run until the end",
                "see what the others printed; the same command goes on from the last checkpoint",
            ) from None

    def peak_gib(self) -> float:
        """Return the largest memory that this process has held so far, in GiB, on its GPU or else in the machine."""
        if self.device.type == "cuda":
            return torch.cuda.max_memory_allocated(self.device) / 2**30
        unit = 1 if sys.platform == "darwin" else 1024  # of ru_maxrss, bytes there and kibibytes elsewhere
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**30

    def any(self, asked: bool) -> bool:
        """Return whether ``asked`` is true in any process."""
        return asked if self.world_size == 1 else bool(self._mean(torch.tensor(float(asked), device=self.device)) > 0)

    def same(self, number: int) -> bool:
        """Return whether a number is the same in all processes."""
        return not self.any(self.world_size > 1 and self._fabric.broadcast(number) != number)

    def step(self, example: Example, seed: int, gradient_clip: float, parts: int = 1) -> dict[str, Tensor]:
        """Take one step, or one for each player in turn, and return the loss terms, averaged over the processes.

        On a CPU no process changes its weights if a loss or a gradient is not finite in any of them. Elsewhere the host
        would have to wait for every step: there :meth:`is_finite` tells it of all steps so far.

        Args:
            parts: number of parts of the share whose gradients are computed one after the other and added up.
        """
        self._objective.train()
        terms: dict[str, Tensor] = {}
        several = f"training.*.accumulate={2 * parts}" if len(example) > parts else "training.*.recompute=true"
        for player in _turns(self._objective.objective):
            with products_in(self._precision), within_memory(len(example) // parts, f"use {several}"):
                found, is_finite = self._step(example, seed, gradient_clip, player, parts)
            terms = _joined(terms, found, player)
            if not is_finite:
                break
        return terms

    def _step(
        self, example: Example, seed: int, gradient_clip: float, player: str, parts: int
    ) -> tuple[dict[str, Tensor], bool]:
        terms: dict[str, Tensor] = {}
        for part in range(parts):
            first, last = (number * len(example) // parts for number in (part, part + 1))
            some = example if parts == 1 else example[first:last]
            with self._fabric.no_backward_sync(self._objective, enabled=part < parts - 1):
                found = self._objective(lambda one=some: one, derive_seed(seed, part) if part else seed, player)
                loss = self._mean(found["loss"].detach().clone())
                if not self._goes_on(loss):
                    return {**found, "loss": loss}, False
                self._fabric.backward(found["loss"] / parts)
            terms = {name: terms.get(name, 0.0) + term.detach() / parts for name, term in found.items()}
        norm = self._fabric.clip_gradients(
            self._objective, self._optimiser, max_norm=gradient_clip or math.inf, error_if_nonfinite=False
        )
        if not self._goes_on(norm):
            return {**terms, "loss": norm}, False
        self._optimiser.step()
        self._optimiser.zero_grad()  # to None: the optimiser leaves alone what the next player does not move
        return self._means(terms), True

    def _goes_on(self, number: Tensor) -> bool:
        """Note whether a loss or gradient is finite, and return whether the step may go on, for all that is known."""
        self._finite = self._finite & number.isfinite()
        return not self.sees_at_once or bool(self._finite)

    def is_finite(self) -> bool:
        """Return whether all losses and gradients so far were finite; the host waits for the device."""
        return bool(self._finite)

    def _mean(self, number: Tensor) -> Tensor:
        return number if self.world_size == 1 else self._fabric.all_reduce(number, reduce_op="mean")

    def _means(self, terms: dict[str, Tensor]) -> dict[str, Tensor]:
        if self.world_size == 1:
            return terms
        together = torch.stack([term.to(self.device, torch.float32) for term in terms.values()])
        return dict(zip(terms, self._mean(together).unbind(), strict=True))

    def evaluate(self, objective: Objective, example: Example, seed: int) -> dict[str, float]:
        """Return an objective's loss terms on a batch, in evaluation mode."""
        was_training = objective.training
        objective.eval()
        terms: dict[str, Tensor] = {}
        with torch.no_grad(), self._fabric.autocast(), products_in(self._precision):
            for player in _turns(objective):
                rng = torch.Generator(self.device).manual_seed(seed)
                terms = _joined(terms, objective(example.to(self.device), rng, player), player)
        objective.train(was_training)
        return {name: float(term) for name, term in terms.items()}


class _UncastInputs(nn.Module):
    """Hands an example to an objective unrounded: Fabric rounds every tensor argument to the training precision.

    The example is passed as a function that returns it.
    """

    def __init__(self, objective: Objective) -> None:
        super().__init__()
        self.objective = objective

    def forward(self, example: Callable[[], Example], seed: int, player: str) -> dict[str, Tensor]:
        device = next(self.objective.parameters()).device
        return self.objective(example(), torch.Generator(device).manual_seed(seed), player)


def _turns(objective: Objective) -> tuple[str, ...]:
    """Return the players of an objective, or one without a name where it has none."""
    return objective.players or ("",)


def _joined(terms: dict[str, Tensor], found: dict[str, Tensor], player: str) -> dict[str, Tensor]:
    """Add a player's terms, with its name before theirs, to those of earlier players, and its loss to their sum."""
    if not player:
        return found
    loss = found["loss"] + terms.get("loss", 0.0)
    return {**terms, "loss": loss, **{f"{player}_{name}": term for name, term in found.items()}}

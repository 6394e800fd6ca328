"""A stage of a run, stopped at any scan: weights, their average, the optimiser → one file and back."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

from lidargrit.files import load_exactly, read_tensors, write_tensors
from lidargrit.training.optimiser import WeightAverage


def save_checkpoint(
    path: Path, objective: nn.Module, average: WeightAverage, optimiser: torch.optim.Optimizer, scans_seen: int
) -> None:
    """Write everything that the next step depends on, atomically: an interrupted save leaves the file before it."""
    tensors: dict[str, Tensor] = {}
    tensors |= {f"objective.{name}": tensor for name, tensor in objective.state_dict().items()}
    tensors |= {f"average.{name}": tensor for name, tensor in average.objective.state_dict().items()}
    for index, state in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{index}.{name}": torch.as_tensor(value) for name, value in state.items()}
    write_tensors(path, tensors, {"scans_seen": scans_seen})


def load_checkpoint(
    path: Path, objective: nn.Module, average: WeightAverage, optimiser: torch.optim.Optimizer | None
) -> int:
    """Load what :func:`save_checkpoint` wrote and return the scans seen; without an optimiser, weights only.

    Raises:
        CheckpointError: a damaged file, or one of another configuration.
    """
    tensors, about = read_tensors(path)
    load_exactly(objective, _below(tensors, "objective."), path)
    load_exactly(average.objective, _below(tensors, "average."), path)
    if optimiser is not None:
        state: dict[int, dict[str, Tensor]] = {}
        for name, tensor in _below(tensors, "optimiser.").items():
            index, _, key = name.partition(".")
            state.setdefault(int(index), {})[key] = tensor
        optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})
    return int(about["scans_seen"])


def _below(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}

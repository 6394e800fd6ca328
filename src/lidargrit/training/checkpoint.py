"""State of a stage in training (weights, their average, the optimiser) ⇄ one file."""

import hashlib
from pathlib import Path

import torch
from torch import Tensor, nn

from lidargrit.core.errors import CheckpointError
from lidargrit.core.files import read_tensors, write_tensors
from lidargrit.core.untrusted import WHOLE_NUMBER_AT_MOST
from lidargrit.nn.exact_weights import load_exactly
from lidargrit.nn.published import weights_below
from lidargrit.training.optimiser import WeightAverage


def save_checkpoint(
    path: Path,
    objective: nn.Module,
    average: WeightAverage,
    optimiser: torch.optim.Optimizer,
    scans_seen: int,
    built_on: str,
) -> None:
    """Write everything that the next step depends on, atomically: an interrupted save leaves the older checkpoint.

    Args:
        built_on: fingerprint of the earlier stage's weights; "" for the first stage.
    """
    tensors: dict[str, Tensor] = {}
    tensors |= {f"objective.{name}": tensor for name, tensor in objective.state_dict().items()}
    tensors |= {f"average.{name}": tensor for name, tensor in average.objective.state_dict().items()}
    for index, state in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{index}.{name}": torch.as_tensor(value) for name, value in state.items()}
    write_tensors(path, tensors, {"scans_seen": scans_seen, "built_on": built_on})


def load_checkpoint(
    path: Path, objective: nn.Module, average: WeightAverage, optimiser: torch.optim.Optimizer, built_on: str
) -> int:
    """Load what :func:`save_checkpoint` wrote and return the scans seen."""
    tensors, about = read_tensors(path)
    if about.get("built_on") != built_on:
        raise CheckpointError(
            f"{path}, which was trained on top of another earlier stage",
            "the stage that this run's earlier stages led to",
            "remove the file, and the stage is trained again",
        )
    load_exactly(objective, weights_below(tensors, "objective."), path)
    load_exactly(average.objective, weights_below(tensors, "average."), path)
    try:
        state = _optimiser_state(weights_below(tensors, "optimiser."), optimiser)
        optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})
        scans_seen = about["scans_seen"]
        if type(scans_seen) is not int or not 0 <= scans_seen <= WHOLE_NUMBER_AT_MOST:
            raise ValueError(f"{str(scans_seen)[:40]} scans seen")
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"{path}, which cannot be used ({error})",
            "what lidargrit wrote",
            "restore the file, or remove it and train again",
        ) from None
    return scans_seen


def load_average(path: Path, objective: nn.Module) -> None:
    """Load the averaged weights of a checkpoint, with all that a finished generator does not keep of its objective."""
    load_exactly(objective, weights_below(read_tensors(path)[0], "average."), path)


def _optimiser_state(tensors: dict[str, Tensor], optimiser: torch.optim.Optimizer) -> dict[int, dict[str, Tensor]]:
    state: dict[int, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        index, _, key = name.partition(".")
        state.setdefault(int(index), {})[key] = tensor
    number = 0
    for group in optimiser.param_groups:
        kinds = set[frozenset[str]]()
        for weight in group["params"]:
            moments = state.get(number, {})
            kinds |= {frozenset(moments)} if moments else set()
            if any(moment.numel() not in (1, weight.numel()) for moment in moments.values()):
                raise ValueError(f"moments of another size for weight {number}")
            number += 1
        if len(kinds) > 1:
            raise ValueError("moments that some weights lack")
    if state.keys() - range(number):
        raise ValueError(f"moments of more than {number} weights")
    return state


def fingerprint(module: nn.Module) -> str:
    """Return a hash of a module's weights."""
    digest = hashlib.sha256()
    for name, tensor in sorted(module.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()

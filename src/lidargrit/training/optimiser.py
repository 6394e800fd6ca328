"""Optimiser, learning rate and moving average of the weights: (configuration, scans seen) → update."""

from __future__ import annotations

import copy
import math

import torch
from torch import nn

from lidargrit.nn.objective import Objective
from lidargrit.training.config import FitConfig


def make_optimiser(objective: nn.Module, config: FitConfig) -> torch.optim.AdamW:
    """Return AdamW with weight decay for linear layers only: not for biases, norms, convolutions or embeddings."""
    decaying = {id(module.weight) for module in objective.modules() if isinstance(module, nn.Linear)}
    learned = [parameter for parameter in objective.parameters() if parameter.requires_grad]
    groups = [
        {"params": [p for p in learned if id(p) in decaying], "weight_decay": config.weight_decay},
        {"params": [p for p in learned if id(p) not in decaying], "weight_decay": 0.0},
    ]
    return torch.optim.AdamW(
        [group for group in groups if group["params"]], lr=config.learning_rate, betas=config.betas
    )


def memory_of_weights(objective: nn.Module) -> int:
    """Return the bytes of weights, of their average, and of gradients and Adam's two moments of the trained weights."""
    tensors = [*objective.parameters(), *objective.buffers()]
    learned = [parameter for parameter in objective.parameters() if parameter.requires_grad]
    return 2 * sum(t.nbytes for t in tensors) + 3 * sum(t.nbytes for t in learned)


def learning_rate_at(config: FitConfig, scans_seen: int) -> float:
    """Return the learning rate of the step that follows ``scans_seen`` scans."""
    share = min(scans_seen / config.scans, 1.0)
    factor = {
        "constant": 1.0,
        "cosine": 0.5 * (1 + math.cos(math.pi * share)),
        "linear_second_half": min(1.0, 2 * (1 - share)),
    }[config.schedule]
    if config.warmup_scans:
        factor *= min(1.0, (scans_seen + config.batch_size) / config.warmup_scans)
    return config.learning_rate * factor


class WeightAverage:
    """A copy of an objective with the moving average of its weights; buffers and fixed weights are copied.

    The half-life grows with the scans seen up to ``half_life_scans``, so that early weights are soon forgotten.

    Args:
        objective: objective whose weights are averaged.
        half_life_scans: number of scans after which a weight counts half; 0 for no averaging.

    Source:
        Karras et al., EDM2, 2023: half-lives in samples, with a ramp.
    """

    def __init__(self, objective: Objective, half_life_scans: int) -> None:
        self.objective = copy.deepcopy(objective).requires_grad_(False)
        self.half_life_scans = half_life_scans

    @torch.no_grad()
    def update(self, objective: nn.Module, scans_seen: int, batch_size: int) -> None:
        """Take in the weights after a step.

        Args:
            objective: objective after the step.
            scans_seen: number of training scans seen so far, over all processes.
            batch_size: number of scans in the step, over all processes.
        """
        half_life = min(self.half_life_scans, 0.1 * scans_seen)
        keep = 0.5 ** (batch_size / half_life) if half_life > 0 else 0.0
        for average, current in zip(self.objective.parameters(), objective.parameters(), strict=True):
            if current.requires_grad:
                average.lerp_(current, 1 - keep)
            else:
                average.copy_(current)
        for average, current in zip(self.objective.buffers(), objective.buffers(), strict=True):
            average.copy_(current)

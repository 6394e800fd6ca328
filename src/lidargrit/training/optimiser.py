"""Optimisers (AdamW, Muon), learning rate and moving average of the weights: (configuration, scans seen) → update."""

import copy
import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from lidargrit.core.errors import ConfigError
from lidargrit.generation.objective import Objective
from lidargrit.generation.settings import TrainingConfig
from lidargrit.nn.blocks import Block
from lidargrit.nn.precision import dtype_of


class Muon(torch.optim.Muon):
    """torch's Muon, in 32 bits on machines without instructions for bfloat16.

    torch orthogonalises in bfloat16 everywhere. A processor that only imitates bfloat16 then spends nine tenths of a
    step of training there. Settings and state are those of torch's Muon, so checkpoints fit both. The momentum is
    always Nesterov's, and a step is as large as AdamW's, so that one learning rate suits both optimisers.

    Source:
        Jordan et al., Muon: An optimizer for hidden layers in neural networks, 2024; the step's size is that of
        Liu et al., Muon is Scalable for LLM Training, 2025.
    """

    def __init__(self, matrices: Iterable[nn.Parameter], lr: float, weight_decay: float) -> None:
        super().__init__(matrices, lr, weight_decay, nesterov=True, adjust_lr_fn="match_rms_adamw")

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Move every matrix that has a gradient."""
        dtype = dtype_of("auto")
        if dtype == torch.bfloat16:
            super().step()
            return
        for group in self.param_groups:
            matrices = [parameter for parameter in group["params"] if parameter.grad is not None]
            for matrix in matrices:
                state = self.state[matrix]
                if "momentum_buffer" not in state:
                    state["momentum_buffer"] = torch.zeros_like(matrix)
                average = state["momentum_buffer"].lerp_(matrix.grad, 1 - group["momentum"])
                step = orthogonalised(matrix.grad.lerp(average, group["momentum"]), group)
                matrix.mul_(1 - group["lr"] * group["weight_decay"])
                matrix.add_(step, alpha=-group["lr"] * 0.2 * max(matrix.shape) ** 0.5)


def orthogonalised(matrix: Float[Tensor, "m n"], group: dict[str, Any]) -> Float[Tensor, "m n"]:
    """Return a matrix with the same singular vectors, whose singular values are all near 1.

    Args:
        group: settings of the iteration, as torch's Muon names them: ns_coefficients, ns_steps and eps.
    """
    linear, cubic, quintic = group["ns_coefficients"]
    is_tall = matrix.shape[0] > matrix.shape[1]
    x = matrix.T if is_tall else matrix
    x = x / x.norm().clamp(min=group["eps"])
    for _ in range(group["ns_steps"]):
        gram = x @ x.T
        x = torch.addmm(x, torch.addmm(gram, gram, gram, beta=cubic, alpha=quintic), x, beta=linear)
    return x.T if is_tall else x


def make_optimiser(objective: nn.Module, config: TrainingConfig) -> torch.optim.Optimizer:
    """Return the optimiser that the configuration names.

    Weights of linear layers decay; biases, norms, convolutions and embeddings do not.
    """
    learned = [parameter for parameter in objective.parameters() if parameter.requires_grad]
    decaying = _ids_of_weights(objective, (nn.Linear,))
    blocks = [module for module in objective.modules() if isinstance(module, Block)]
    hidden = set().union(*map(_ids_of_weights, blocks)) if config.optimiser == "muon" else set()
    matrices = [p for p in learned if id(p) in hidden]
    others = [p for p in learned if id(p) not in hidden]
    groups = [
        {"params": [p for p in others if id(p) in decaying], "weight_decay": config.weight_decay},
        {"params": [p for p in others if id(p) not in decaying], "weight_decay": 0.0},
    ]
    adamw = torch.optim.AdamW(
        [group for group in groups if group["params"]], lr=config.learning_rate, betas=config.betas, fused=True
    )
    if config.optimiser == "adamw":
        return adamw
    if not matrices:
        raise ConfigError(
            "optimiser=muon for networks without linear layers or convolutions in blocks",
            "a stage with a transformer or residual blocks",
            "leave the stage's optimiser out: adamw is the default",
        )
    with _as_matrices(matrices):
        muon = Muon(matrices, config.learning_rate, config.weight_decay)
    return _Together([muon, adamw], matrices)


def _ids_of_weights(module: nn.Module, kinds: tuple[type[nn.Module], ...] = (nn.Linear, nn.Conv2d)) -> set[int]:
    return {id(part.get_parameter("weight")) for part in module.modules() if isinstance(part, kinds)}


@contextmanager
def _as_matrices(weights: Sequence[nn.Parameter]) -> Iterator[None]:
    """Give each kernel and its gradient the shape of a matrix of one row for each output channel, as Muon takes it."""
    kernels = [(weight, weight.data, weight.grad) for weight in weights if weight.ndim > 2]
    for weight, values, gradient in kernels:
        weight.grad = None
        weight.data = values.flatten(1)  # a copy where channels lie innermost: checkpoints know one order
        weight.grad = None if gradient is None else gradient.flatten(1)
    try:
        yield
    finally:
        for weight, values, gradient in kernels:
            weight.grad = None
            weight.data = values.copy_(weight.data.view(values.shape))
            weight.grad = gradient


class _Together(torch.optim.Optimizer):
    """Several optimisers that step as one; their parameter groups and their states are those of this one.

    Args:
        matrices: weights that take the shape of matrices while the optimisers step.
    """

    def __init__(self, parts: list[torch.optim.Optimizer], matrices: Sequence[nn.Parameter]) -> None:
        super().__init__([group for part in parts for group in part.param_groups], {})
        self._parts, self._matrices = parts, matrices
        self._share()

    def _share(self) -> None:
        first = 0
        for part in self._parts:
            last = first + len(part.param_groups)
            part.param_groups, part.state, first = self.param_groups[first:last], self.state, last

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        super().load_state_dict(state_dict)
        self._share()

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        with _as_matrices(self._matrices):
            for part in self._parts:
                part.step()


def memory_of_weights(objective: nn.Module) -> int:
    """Return the bytes of weights, of their average, and of gradients and Adam's two moments of the trained weights."""
    tensors = [*objective.parameters(), *objective.buffers()]
    learned = [parameter for parameter in objective.parameters() if parameter.requires_grad]
    return 2 * sum(t.nbytes for t in tensors) + 3 * sum(t.nbytes for t in learned)


def learning_rate_at(config: TrainingConfig, scans_seen: int) -> float:
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
            scans_seen: number of training scans seen so far, over all processes.
            batch_size: number of scans in the step, over all processes.
        """
        half_life = min(self.half_life_scans, 0.1 * scans_seen)
        keep = 0.5 ** (batch_size / half_life) if half_life > 0 else 0.0
        pairs = list(zip(self.objective.parameters(), objective.parameters(), strict=True))
        averages, learned = zip(*(pair for pair in pairs if pair[1].requires_grad), strict=True)
        get_ema_multi_avg_fn(keep)(averages, learned, None)
        fixed = [pair for pair in pairs if not pair[1].requires_grad]
        for average, current in (*fixed, *zip(self.objective.buffers(), objective.buffers(), strict=True)):
            average.copy_(current)

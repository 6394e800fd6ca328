"""Muon: the gradient of a matrix → an orthogonal step, in a number type that this machine computes in."""

from collections.abc import Iterable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

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

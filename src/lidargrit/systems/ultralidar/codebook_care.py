"""Codes that no latent chooses → codes where latents are: k-means over a reservoir of latents, now and then."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from lidargrit.nn.precision import without_autocast
from lidargrit.nn.processes import of_first_process, sample_from_all, sum_over_processes

_LATENTS_PER_CODE = 10  # in the reservoir
_NEW_SHARE = 0.01  # of the reservoir, taken in at every step
_IDLE_STEPS, _IDLE_SHARE = 256, 0.03  # a code is idle after so many steps without use; so many idle codes start k-means
_REST_STEPS = 1000  # between two k-means
_ROUNDS = 50  # of k-means


class CodebookCare(nn.Module):
    """Watches how a codebook is used in training, and moves its codes when too many lie idle.

    The latents of the last hundred steps are kept as a reservoir. When more than 3 % of the codes have not been chosen
    for 256 steps, k-means over the reservoir begins at the codes in use, and at random latents in place of the idle
    ones. It is done at most every 1,000 steps.

    Args:
        num_codes: number of codes.
        code_dim: length of a code.

    Source:
        myc634/UltraLiDAR_nusc_waymo@eb65fe0 (MIT). Its counter of idle steps begins at 0, as here, so that its k-means
        of the start comes after 256 steps.
    """

    reservoir: Tensor
    filled: Tensor
    idle_steps: Tensor
    rest_steps: Tensor

    def __init__(self, num_codes: int, code_dim: int) -> None:
        super().__init__()
        self.register_buffer("reservoir", torch.zeros(_LATENTS_PER_CODE * num_codes, code_dim))
        self.register_buffer("filled", torch.tensor(0))  # newest rows of the reservoir that hold a latent
        self.register_buffer("idle_steps", torch.zeros(num_codes, dtype=torch.long))
        self.register_buffer("rest_steps", torch.tensor(0))  # until k-means may be done again

    @torch.no_grad()
    def update(
        self,
        codes: Float[Tensor, "K D"],
        latents: Float[Tensor, "n D"],
        tokens: Int[Tensor, "n"],
        rng: torch.Generator | None,
    ) -> None:
        """Take in the latents of a step, and move the codes, in place, if it is time.

        Args:
            codes: codes of the codebook, changed in place.
            latents: latents of the step, of this process.
            tokens: index of the code that each of them chose.
        """
        counts = torch.zeros(len(codes), device=codes.device).index_add_(0, tokens, torch.ones_like(tokens).float())
        used = sum_over_processes(counts) > 0
        self.idle_steps.copy_(torch.where(used, 0, self.idle_steps + 1))
        new = sample_from_all(latents.float(), max(1, round(_NEW_SHARE * len(self.reservoir))), rng)
        self.reservoir.copy_(torch.cat((self.reservoir, new))[len(new) :])
        self.filled.copy_((self.filled + len(new)).clamp(max=len(self.reservoir)))
        self.rest_steps.copy_((self.rest_steps - 1).clamp(min=0))
        idle = self.idle_steps >= _IDLE_STEPS
        if idle.is_meta:  # without values, where operations are only counted: k-means is rare
            return
        if int(self.rest_steps) == 0 and float(idle.float().mean()) > _IDLE_SHARE:
            with without_autocast(codes.device):  # codes lie too close together for 16 bits
                codes.copy_(of_first_process(self._moved(codes, idle, rng)))
            self.idle_steps.zero_()
            self.rest_steps.fill_(_REST_STEPS)

    def _moved(self, codes: Tensor, idle: Bool[Tensor, "K"], rng: torch.Generator | None) -> Float[Tensor, "K D"]:
        latents = self.reservoir[-int(self.filled) :]
        centres = torch.where(idle[:, None], sample_from_all(latents, len(codes), rng), codes)
        for _ in range(_ROUNDS):
            nearest = (centres.square().sum(dim=1) - 2 * latents @ centres.T).argmin(dim=1)
            counts = torch.bincount(nearest, minlength=len(centres))[:, None]
            sums = torch.zeros_like(centres).index_add_(0, nearest, latents)
            centres = torch.where(counts > 0, sums / counts.clamp(min=1), centres)
        return centres

"""Vector quantisation: each latent is replaced by the nearest code of a learned codebook."""

from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from lidargrit.nn.collectives import sample_from_all, sum_over_processes
from lidargrit.nn.precision import in_full

CodebookLoss = Literal["paper", "reference", "vqvae", "ema"]

# Weights of (commitment: move the latent, codebook: move the code). The paper gives both weight 1; the program, by a
# bug of an ancestor, puts its beta of 0.25 on the codebook; van den Oord et al., 2017, put it on the commitment. With
# "ema" the codes follow the mean of their latents instead of a gradient (same paper, appendix A.1).
_LOSS_WEIGHTS = {"paper": (1.0, 1.0), "reference": (1.0, 0.25), "vqvae": (0.25, 1.0), "ema": (0.25, 0.0)}
_EMA_DECAY = 0.99
_COLLAPSED_BELOW = 0.05  # perplexity over number of codes; healthy codebooks of ours keep above a half
_DEAD_BELOW = 0.1  # a code that is chosen less often than this share of an even use is dead


class Quantised(NamedTuple):
    """The result of quantising a batch of latents.

    Args:
        latents: nearest codes; gradients pass straight through to the latents.
        tokens: indices of these codes.
        loss: loss that moves latents and codes towards each other.
    """

    latents: Float[Tensor, "B D h w"]
    tokens: Int[Tensor, "B h w"]
    loss: Float[Tensor, ""]


class VectorQuantiser(nn.Module):
    """A codebook, with counts of how its codes are used.

    Args:
        loss: name of the terms that move codes and latents towards each other; see ``_LOSS_WEIGHTS``.
        restart_dead: whether training replaces codes that are hardly ever chosen by latents of the batch, so that the
            codebook does not collapse. The reference has no such remedy.
    """

    usage: Tensor
    code_sums: Tensor

    def __init__(self, num_codes: int, code_dim: int, loss: CodebookLoss, restart_dead: bool) -> None:
        super().__init__()
        self.loss, self.restart_dead = loss, restart_dead
        self.embedding = nn.Embedding(num_codes, code_dim)
        nn.init.uniform_(self.embedding.weight, -1 / num_codes, 1 / num_codes)
        self.embedding.weight.requires_grad_(loss != "ema")
        self.register_buffer("usage", torch.zeros(num_codes))  # running number of latents a batch brings to each code
        self.register_buffer("code_sums", torch.zeros(num_codes, code_dim))

    def forward(self, z: Float[Tensor, "B D h w"], rng: torch.Generator | None = None) -> Quantised:
        """Replace every latent by its nearest code; ``rng`` chooses the latents that dead codes restart from."""
        with in_full(z.device):  # codes lie too close together for 16 bits
            return self._quantise(z.float(), rng)

    def _quantise(self, z: Tensor, rng: torch.Generator | None) -> Quantised:
        flat = z.movedim(1, -1).flatten(0, -2)
        tokens = self.nearest(flat)
        if self.training:
            self._update_codes(flat.detach(), tokens, rng)
        codes = self.lookup(tokens.unflatten(0, (z.shape[0], *z.shape[2:])))
        commitment_weight, codebook_weight = _LOSS_WEIGHTS[self.loss]
        loss = commitment_weight * F.mse_loss(z, codes.detach()) + codebook_weight * F.mse_loss(codes, z.detach())
        return Quantised(z + (codes - z).detach(), tokens.unflatten(0, (z.shape[0], *z.shape[2:])), loss)

    def nearest(self, flat: Float[Tensor, "n D"]) -> Int[Tensor, "n"]:
        """Return the index of the nearest code, the first among equals."""
        codes = self.embedding.weight
        return (flat.square().sum(1, keepdim=True) + codes.square().sum(1) - 2 * flat @ codes.T).argmin(dim=1)

    def lookup(self, tokens: Int[Tensor, "B h w"]) -> Float[Tensor, "B D h w"]:
        """Return the codes of tokens."""
        return self.embedding(tokens).movedim(-1, 1)

    def perplexity(self) -> Float[Tensor, ""]:
        """Return exp(entropy) of how often codes are used: the number of codes in effective use."""
        share = self.usage / self.usage.sum().clamp(min=1e-9)
        return torch.special.entr(share).sum().exp()

    def warnings(self, remedy: str) -> list[str]:
        """Return a line with the remedy if few codes are in effective use."""
        perplexity, count = float(self.perplexity()), len(self.usage)
        if perplexity >= _COLLAPSED_BELOW * count:
            return []
        alive = float((self.usage > self._dead_below()).float().mean())
        used = f"{perplexity:.1f} of {count} codes in effect, {alive:.0%} alive"
        return [f"the codebook has collapsed: {used}; the remedy: {remedy}"]

    @torch.no_grad()
    def share(self) -> Float[Tensor, "K"]:
        """Return how often each code is used; before any training, all alike."""
        share = self.usage / self.usage.sum().clamp(min=1e-9)
        return torch.where(share.any(), share, 1 / len(share))

    @torch.no_grad()
    def spread(self) -> Float[Tensor, ""]:
        """Return the standard deviation of the numbers in codes, each as often as its code is used.

        Before any training, all codes count alike.
        """
        codes, share = self.embedding.weight, self.share()
        means = [(share[:, None] * power).sum() / codes.shape[1] for power in (codes, codes.square())]
        return (means[1] - means[0].square()).sqrt()

    @torch.no_grad()
    def _update_codes(self, flat: Tensor, tokens: Tensor, rng: torch.Generator | None) -> None:
        """Count how often codes are used, move codes that follow the mean of their latents, and restart dead ones."""
        # Nothing here reads a value: a GPU does not wait, and operations can be counted on tensors without values.
        ones = torch.ones_like(tokens, dtype=flat.dtype)
        counts = sum_over_processes(torch.zeros_like(self.usage).index_add_(0, tokens, ones))
        sums = sum_over_processes(torch.zeros_like(self.code_sums).index_add_(0, tokens, flat))
        fresh = self.usage.sum() == 0
        self.usage.copy_(torch.where(fresh, counts, torch.lerp(counts, self.usage, _EMA_DECAY)))
        self.code_sums.copy_(torch.where(fresh, sums, torch.lerp(sums, self.code_sums, _EMA_DECAY)))
        if self.loss == "ema":
            smoothed = (self.usage + 1e-5).unsqueeze(1)
            alive = (self.usage > 1e-3).unsqueeze(1)
            self.embedding.weight.copy_(torch.where(alive, self.code_sums / smoothed, self.embedding.weight))
        if self.restart_dead:
            self._restart(flat, counts, rng)

    def _restart(self, flat: Tensor, counts: Tensor, rng: torch.Generator | None) -> None:
        dead = (self.usage < self._dead_below()) & (counts == 0)  # not those that this batch is about to look up
        candidates = sample_from_all(flat, len(dead), rng)
        even_use = self.usage.mean().expand_as(self.usage)
        self.embedding.weight.copy_(torch.where(dead.unsqueeze(1), candidates, self.embedding.weight))
        self.usage.copy_(torch.where(dead, even_use, self.usage))
        self.code_sums.copy_(torch.where(dead.unsqueeze(1), candidates * even_use.unsqueeze(1), self.code_sums))

    def _dead_below(self) -> Tensor:
        return _DEAD_BELOW * self.usage.mean()

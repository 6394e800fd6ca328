"""What systems that write the tokens of a VQ-VAE have in common, in whatever order they write them."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from lidargrit.generators import Generator
from lidargrit.nn.flops import flops_of
from lidargrit.nn.processes import sum_over_processes
from lidargrit.nn.transformer import Transformer
from lidargrit.sensors import SensorModel
from lidargrit.structures import RangeImage, TokenGrid
from lidargrit.tokenizers import MaskDecoding, Tokenizer
from lidargrit.tokenizers.vqvae import Vqvae

_DECODED_AT_ONCE = 4  # enough to keep a GPU busy; more would only take memory, 35 MB a scan and layer at 64x1024


class TokenGenerator(Generator):
    """A VQ-VAE, trained first, and a ``transformer`` over its tokens, trained over the frozen VQ-VAE."""

    stages = ("tokenizer", "transformer")
    capabilities = frozenset({"tokens", "encode"})

    def __init__(self, config: Any, sensor: SensorModel) -> None:
        super().__init__(config, sensor)
        self.config, self.sensor = config, sensor
        self.tokenizer = Vqvae(config.tokenizer, sensor)

    def finish(self, stage: str, objective: nn.Module) -> None:
        """Take over a stage's trained weights."""
        if stage == "tokenizer":
            self.tokenizer.load_state_dict(objective.state_dict())
        else:
            trained = objective.get_submodule("transformer")
            self.get_submodule("transformer").load_state_dict(trained.state_dict())

    def get_tokenizer(self) -> Tokenizer:
        """Return the VQ-VAE."""
        return self.tokenizer

    @torch.no_grad()
    def reconstruct(self, images: RangeImage) -> RangeImage:
        """Return what the tokens keep of a batch of scans, the mask by threshold."""
        return self.tokenizer.decode(self.tokenizer.encode(images))

    def decode(
        self, tokens: Int[Tensor, "B T"], rngs: list[torch.Generator], mask: MaskDecoding, tokenizer: Vqvae
    ) -> RangeImage:
        """Return the scans of written tokens.

        Args:
            tokens: in raster order.
            rngs: on the CPU, one for each scan, from which returns are drawn.
            mask: how returns are decided.
            tokenizer: the VQ-VAE, or what it gives for decoding only.
        """
        size = (self.sensor.height, self.sensor.width)
        images = []
        for first in range(0, len(tokens), _DECODED_AT_ONCE):
            some = slice(first, first + _DECODED_AT_ONCE)
            grid = TokenGrid(tokens[some].unflatten(1, tokenizer.grid_size), tokenizer.num_codes)
            uniform = torch.stack([torch.rand(size, generator=rng) for rng in rngs[some]]).to(tokens.device)
            part = tokenizer.decode(grid, mask, uniform)
            images += [part[index] for index in range(len(part))]
        return RangeImage.stack(images)

    def decoding_flops(self) -> int:
        """Count the operations of decoding the tokens of one scan."""
        latents = (1, self.tokenizer.config.code_dim, *self.tokenizer.grid_size)
        decoder = self.tokenizer.decoder.prepared("fp32")
        return flops_of(self.tokenizer.post_quant_conv, latents) + flops_of(decoder, latents)


class TokenObjective(nn.Module):
    """What a transformer over the tokens of a frozen tokenizer learns from."""

    token_counts: Tensor

    def __init__(self, tokenizer: Tokenizer, transformer: Transformer) -> None:
        super().__init__()
        self.transformer, self.sensor = transformer, tokenizer.sensor
        self._frozen = [tokenizer.eval().requires_grad_(False)]  # in a list: its weights are not this stage's
        self.register_buffer("token_counts", torch.ones(transformer.num_tokens))

    @torch.no_grad()
    def encode(self, images: RangeImage) -> tuple[Int[Tensor, "B T"], Float[Tensor, "B T"]]:
        """Return the tokens, and the nats that each takes from a model which knows only how often tokens occur."""
        # Tokens are made in full precision, as they are when a scan is encoded outside of training.
        with torch.autocast(images.range_m.device.type, enabled=False):
            self._frozen[0].to(images.range_m.device)
            tokens = self._frozen[0].encode(images).tokens.flatten(1)
        if self.training:
            counted = torch.bincount(tokens.flatten(), minlength=len(self.token_counts))
            self.token_counts += sum_over_processes(counted)
        return tokens, -(self.token_counts / self.token_counts.sum()).log()[tokens]


def draw_tokens(logits: Float[Tensor, "*B K"], uniform: Float[Tensor, "*B"]) -> Int[Tensor, "*B"]:
    """Draw one token for each row of logits: where the distribution function first exceeds its uniform number."""
    distribution = logits.double().softmax(dim=-1).cumsum(dim=-1)
    threshold = uniform.double()[..., None] * distribution[..., -1:]  # the sum may miss 1 by a rounding error
    return torch.searchsorted(distribution, threshold, right=True)[..., 0].clamp(max=logits.shape[-1] - 1)

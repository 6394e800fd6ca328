"""Which parts of a transformer's preset pay: trainings that differ in one part, over several seeds → nats a token.

    OMP_NUM_THREADS=1 python benchmarks/transformer_parts.py parts.jsonl --train simulated:3000:train

The tokens are those of a finished model. For each seed the training scans are encoded once, flipped and begun at a
random fine column as the presets do, and every part learns from the same tokens in the same order. Each finished
training is a line of the file; the same command goes on after the last one. Prints for each part the nats a token on
validation scans, which no sampling blurs, the difference from the base seed by seed, and the training's processor time.
"""

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from lidargrit.data.batches import Batches
from lidargrit.data.sources import open_images
from lidargrit.generation.generator import load
from lidargrit.generation.settings import TrainingConfig
from lidargrit.nn.precision import dtype_of
from lidargrit.nn.transformer import CausalTransformer, TransformerBlock, TransformerConfig
from lidargrit.scans.types import RangeImage
from lidargrit.systems.lidargrit.system import LidarGrit, after_start
from lidargrit.training.optimiser import learning_rate_at, make_optimiser

BATCH = 8
_ORDERS = 2  # random orders of each validation scan, over which the nats are averaged
_SIZE = {"layers": 4, "heads": 4, "width": 192}  # of the preset ``lidargrit_small``


@dataclass(frozen=True)
class Part:
    """One training; the defaults are the base.

    Args:
        optimiser: ``muon`` for the matrices of the blocks and AdamW for the rest, or ``adamw`` for all.
        learning_rate: highest learning rate.
        dropout: probability of dropout on the embedded tokens and on what blocks add.
        qk_norm: whether queries and keys of each head are divided by their root mean square, and scaled as learned.
        z_loss: weight of the squared logarithm of the softmax's denominator.
        positions: ``learned`` vectors for all positions, ``rotary`` turns of queries and keys, or both.
        roll: whether token grids are rolled about the azimuth, and whether an embedding tells by how much.
        random_order: whether each scan's tokens come in an order of their own, and the next position is told.
    """

    optimiser: Literal["muon", "adamw"] = "muon"
    learning_rate: float = 3e-3
    dropout: float = 0.0
    qk_norm: bool = False
    z_loss: float = 0.0
    positions: Literal["learned", "rotary", "both"] = "learned"
    roll: Literal["none", "untold", "told"] = "none"
    random_order: bool = False


PARTS = {
    "base": Part(),
    "AdamW for all": Part(optimiser="adamw", learning_rate=1e-3),
    "dropout .1": Part(dropout=0.1),
    "QK-norm": Part(qk_norm=True),
    "z-loss": Part(z_loss=1e-4),
    "rotary": Part(positions="rotary"),
    "rotary and learned": Part(positions="both"),
    "rolled": Part(roll="untold"),
    "rolled, told": Part(roll="told"),
    "random order": Part(random_order=True),
}


class PartAttention(nn.Module):
    """A block's attention with its queries and keys normalised, or turned by their positions, or both.

    Args:
        block: block whose attention's layers are taken over.
        part: the part that is tried.
        angles: angles by which the pairs of channels of a head are turned, from the position before the first on; a key
            is turned by the position of the token that was read there, a query by that of the token to predict.
    """

    def __init__(self, block: TransformerBlock, part: Part, angles: Float[Tensor, "T+1 pairs"]) -> None:
        super().__init__()
        self.plain = block.attn
        channels = 2 * angles.shape[1]
        self.norms = nn.ModuleList(nn.RMSNorm(channels, eps=1e-6) for _ in range(2 * part.qk_norm))
        self.angles = None if part.positions == "learned" else angles

    def forward(self, x: Float[Tensor, "B T C"]) -> Float[Tensor, "B T C"]:
        """Attend to the tokens so far."""
        layers = (self.plain.query, self.plain.key, self.plain.value)
        q, k, v = (layer(x).unflatten(-1, (self.plain.heads, -1)).transpose(1, 2) for layer in layers)
        if len(self.norms):
            q, k = self.norms[0](q.float()), self.norms[1](k.float())
        if self.angles is not None:
            q, k = turned(q, self.angles[1 : q.shape[2] + 1]), turned(k, self.angles[: k.shape[2]])
        mixed = F.scaled_dot_product_attention(q.to(v.dtype), k.to(v.dtype), v, is_causal=True)
        return self.plain.proj(mixed.transpose(1, 2).flatten(-2))


def turned(x: Float[Tensor, "B heads T d"], angles: Float[Tensor, "T pairs"]) -> Float[Tensor, "B heads T d"]:
    """Turn each pair of channels, one of either half of a head, by its angle."""
    a, b = x.chunk(2, dim=-1)
    cos, sin = angles.cos().to(x.dtype), angles.sin().to(x.dtype)
    return torch.cat((a * cos - b * sin, a * sin + b * cos), dim=-1)


def angles_of(grid: tuple[int, int], pairs: int) -> Float[Tensor, "T+1 pairs"]:
    """Return the angles in radians, from the position before the first on: half by rows, half by columns.

    Whole turns around the azimuth, from none on, make the last column a neighbour of the first.
    """
    rows, columns = grid
    position = torch.arange(-1, rows * columns)
    by_row = rows ** -torch.linspace(0, 1, pairs // 2)  # radians a row, from 1 to 1 / rows
    by_column = 2 * torch.pi / columns * torch.arange(pairs - pairs // 2)
    row, column = position.div(columns, rounding_mode="floor"), position % columns
    return torch.cat((row[:, None] * by_row, column[:, None] * by_column), dim=1)


class PartTransformer(CausalTransformer):
    """The transformer with one part changed; the weights of a seed that all parts have begin alike."""

    def __init__(self, part: Part, num_tokens: int, grid: tuple[int, int]) -> None:
        sizes = TransformerConfig(**_SIZE, embedding_dropout=part.dropout, residual_dropout=part.dropout)
        super().__init__(sizes, num_tokens, grid)
        self.part, self.grid = part, grid
        self.pos_emb.requires_grad_(part.positions != "rotary")  # they begin as 0, and so have no effect
        if part.qk_norm or part.positions != "learned":
            angles = angles_of(grid, sizes.width // sizes.heads // 2)
            for block in self.blocks:
                assert isinstance(block, TransformerBlock)
                block.attn = PartAttention(block, part, angles)  # type: ignore[assignment]
        if part.roll == "told":
            self.offset_emb = nn.Parameter(torch.zeros(grid[1], sizes.width))
        if part.random_order:
            self.own_pos_emb = nn.Parameter(torch.zeros(self.context_length + 1, sizes.width))

    def losses(self, tokens: Int[Tensor, "B T"], rng: torch.Generator) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
        """Return nats a token, and what is added to them in training; in validation scans are not rolled."""
        positions = self.pos_emb
        if self.part.roll != "none":
            columns = self.grid[1]
            offset = torch.randint(columns, (len(tokens), 1, 1), generator=rng) * self.training
            column = (torch.arange(columns) + offset) % columns
            tokens = tokens.unflatten(1, self.grid).gather(2, column.expand(-1, *self.grid)).flatten(1)
            if self.part.roll == "told":
                positions = positions + self.offset_emb[offset[:, :, 0]]
        if self.part.random_order:
            order = torch.rand(tokens.shape, generator=rng).argsort(1)
            tokens = tokens.gather(1, order)
            positions = positions[0, order] + self.own_pos_emb[F.pad(order[:, :-1], (1, 0), value=-1)]
        x = self.drop(self.tok_emb(after_start(tokens[:, :-1])) + positions)
        for block in self.blocks:
            x = block(x)
        logits = self.head(self.ln_f(x)).float()
        nats = F.cross_entropy(logits.flatten(0, 1), tokens.flatten())
        if not self.part.z_loss:
            return nats, torch.zeros_like(nats)
        return nats, self.part.z_loss * logits.logsumexp(-1).square().mean()


def in_precision() -> torch.autocast:
    """Compute in 16 bits where the machine has instructions for it, as the presets do."""
    return torch.autocast("cpu", torch.bfloat16, enabled=dtype_of("auto") == torch.bfloat16)


def train(model: PartTransformer, tokens: Int[Tensor, "N T"], seed: int) -> float:
    """Train on tokens in their order, once, and return the processor seconds."""
    part = model.part
    config = TrainingConfig(
        scans=len(tokens),
        batch_size=BATCH,
        learning_rate=part.learning_rate,
        schedule="cosine",
        warmup_scans=len(tokens) // 10,
        optimiser=part.optimiser,
        weight_decay=0.01,
    )
    optimiser, rng = make_optimiser(model, config), torch.Generator().manual_seed(seed)
    begun = time.process_time()
    for seen in range(0, config.scans, BATCH):
        for group in optimiser.param_groups:
            group["lr"] = learning_rate_at(config, seen)
        with in_precision():
            nats, added = model.losses(tokens[seen : seen + BATCH], rng)
        optimiser.zero_grad()
        (nats + added).backward()
        nn.utils.clip_grad_norm_(model.parameters(), config.gradient_clip)
        optimiser.step()
    return time.process_time() - begun


@torch.inference_mode()
def validate(model: PartTransformer, tokens: Int[Tensor, "N T"]) -> float:
    """Return nats a token of validation scans."""
    model.eval()
    rng, nats, orders = torch.Generator().manual_seed(0), [], _ORDERS if model.part.random_order else 1
    for _ in range(orders):
        for some in tokens.split(BATCH):
            with in_precision():
                nats.append(float(model.losses(some, rng)[0]) * len(some) / len(tokens))
    return sum(nats) / orders


class Tokens:
    """Scans → tokens of a finished model, by its tokenizer."""

    def __init__(self, model: str, train: str, val: str) -> None:
        generator = load(model)
        assert isinstance(generator, LidarGrit), model
        self.tokenizer, self._train = generator.tokenizer.eval(), open_images(train, sensor=generator.sensor)
        images = open_images(val, sensor=generator.sensor)
        some = [range(len(images))[first : first + BATCH] for first in range(0, len(images), BATCH)]
        self.val = torch.cat([self._encode(images.batch(indices)) for indices in some])

    @torch.no_grad()
    def _encode(self, images: RangeImage) -> Int[Tensor, "B T"]:
        return self.tokenizer.encode(images).tokens.flatten(1)

    def of_seed(self, seed: int, scans: int) -> Int[Tensor, "N T"]:
        """Return the tokens of as many training scans, in the order and with the augmentation of a seed."""
        batches = Batches(self._train, BATCH, ("flip",), any_columns=True, seed=seed)
        return torch.cat([self._encode(example.images) for example in batches.stream(0, scans)])

    def rolls_with_images(self) -> float:
        """Return how many tokens of some scans, rolled by one to all cells, are those of the images rolled alike."""
        images, (rows, columns) = self._train.batch([0]), self.tokenizer.grid_size
        grid, cell = self._encode(images).view(1, rows, columns), images.range_m.shape[-1] // columns
        same = [
            self._encode(images.mapped(lambda pixels, by=by: pixels.roll(by * cell, -1)))
            == grid.roll(by, -1).flatten(1)
            for by in range(1, columns + 1)
        ]
        return float(torch.cat(same).float().mean())


def print_table(runs: list[dict]) -> None:
    """Print a line for each part."""
    nats = {(run["part"], run["seed"]): run["nats"] for run in runs}
    print(f"| part | nats a token | from base | seeds | processor s |\n|{'---|' * 5}")
    for name in PARTS:
        own = [run for run in runs if run["part"] == name]
        found = [run["nats"] for run in own]
        seeds = [run["seed"] for run in own if name != "base" and ("base", run["seed"]) in nats]
        apart = [nats[name, seed] - nats["base", seed] for seed in seeds]
        spread = " | ".join(
            f"{mean(each):{sign}.4f} ({min(each):{sign}.4f} to {max(each):{sign}.4f})" if each else ""
            for each, sign in ((found, ""), (apart, "+"))
        )
        if own:
            print(f"| {name} | {spread} | {len(own)} | {mean(run['seconds'] for run in own):.0f} |")


def main(words: Sequence[str] | None = None) -> None:
    """Train what is missing, seed by seed, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="file of one JSON line a training")
    parser.add_argument("--model", default="pretrained", help="finished run with the tokenizer (default: %(default)s)")
    parser.add_argument("--train", default="simulated:3000:train", help="source of scans (default: %(default)s)")
    parser.add_argument("--val", default="simulated:256:val", help="source of scans (default: %(default)s)")
    parser.add_argument("--scans", type=int, default=2400, help="scans seen in a training (default: %(default)s)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS), metavar="PART")
    options = parser.parse_args(words)
    runs = [json.loads(line) for line in options.out.read_text().splitlines()] if options.out.exists() else []
    settings = {name: getattr(options, name) for name in ("model", "train", "val", "scans")}
    runs = [run for run in runs if all(run[name] == value for name, value in settings.items())]
    done, encoded = {(run["part"], run["seed"]) for run in runs}, None
    for seed in options.seeds:
        missing = [name for name in options.parts if (name, seed) not in done]
        if not missing:
            continue
        if encoded is None:
            encoded = Tokens(options.model, options.train, options.val)
            print(f"tokens that roll with their images: {100 * encoded.rolls_with_images():.2f} %", flush=True)
        tokens = encoded.of_seed(seed, options.scans)
        for name in missing:
            torch.manual_seed(seed)  # of weights and dropout
            model = PartTransformer(PARTS[name], encoded.tokenizer.num_codes, encoded.tokenizer.grid_size)
            seconds = train(model, tokens, seed)
            nats = validate(model, encoded.val)
            runs.append({"part": name, "seed": seed, "nats": nats, "seconds": seconds, **settings})
            with options.out.open("a") as file:
                file.write(json.dumps(runs[-1]) + "\n")
            print(json.dumps(runs[-1]), flush=True)
    print_table(runs)


if __name__ == "__main__":
    main()

"""What an experiment is: data, model, and how long and how each of its stages learns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from lidargrit.augmentation import Augmentation
from lidargrit.errors import ConfigError
from lidargrit.loading import DataConfig

_BATCH_AT_MOST = 65_536  # scans: 4 GB of the smallest images, and more than any step learns from


@dataclass(frozen=True)
class FitConfig:
    """How one stage of a model learns; every duration is counted in scans seen.

    Args:
        scans: the budget.
        batch_size: over all processes.
        accumulate: each process takes its share of a batch in so many parts, one after the other: less memory, and the
            same step up to rounding, but for a codebook, which follows or restarts its codes after each part.
        learning_rate: at its highest.
        schedule: ``constant``; ``cosine`` falls to 0 over the budget; ``linear_second_half`` is constant for the first
            half and then falls to 0 (the reference's for its KITTI-360 transformer).
        warmup_scans: the rate rises linearly over this many scans.
        betas: of Adam.
        weight_decay: on the weights of linear layers only, as in the reference.
        gradient_clip: largest norm of the gradient; 0 for none.
        average_over_scans: half-life of the moving average of the weights that is sampled and scored; 0 for none.
        precision: ``bf16`` runs convolutions and products in 16 bits, sums and losses in 32; ``auto`` does so where the
            machine has instructions for it, for elsewhere it is many times slower.
        recompute: drop the activations within blocks, and compute them again for the gradients: less memory, the same
            gradients, about a third more operations.
        compile: by ``torch.compile``, which needs a C++ compiler, and minutes before the first step.
        augmentations: see lidargrit.augmentation.
        any_columns: where the sensor keeps every n-th column, begin at any of the first n each time a scan is seen: n
            times as many images of the same scans. The reference always keeps the first.
        validate_every: scans between two validations, which take at most ``validation_scans`` scans.
        validation_scans: see above.
        checkpoint_every: scans between two checkpoints.
        pictures_every: scans between two pictures of what the model makes of validation scans; 0 for none.
    """

    scans: int
    batch_size: int
    learning_rate: float
    schedule: Literal["constant", "cosine", "linear_second_half"] = "constant"
    warmup_scans: int = 0
    betas: tuple[float, float] = (0.9, 0.95)
    weight_decay: float = 0.0
    gradient_clip: float = 1.0
    average_over_scans: int = 1000
    accumulate: int = 1
    precision: Literal["fp32", "bf16", "auto"] = "fp32"
    recompute: bool = False
    compile: bool = False
    augmentations: tuple[Augmentation, ...] = ()
    any_columns: bool = False
    validate_every: int = 1000
    validation_scans: int = 64
    checkpoint_every: int = 1000
    pictures_every: int = 0

    def __post_init__(self) -> None:
        for name in ("scans", "batch_size", "accumulate", "validate_every", "validation_scans", "checkpoint_every"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name}={getattr(self, name)}", "at least 1", "raise it")
        for name in ("warmup_scans", "weight_decay", "gradient_clip", "average_over_scans", "pictures_every"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"{name}={getattr(self, name)}", "0 or more", "raise it")
        if self.batch_size > _BATCH_AT_MOST:
            raise ConfigError(f"batch_size={self.batch_size}", f"at most {_BATCH_AT_MOST}", "lower it")
        if not all(0 <= beta < 1 for beta in self.betas):
            raise ConfigError(f"betas={self.betas}", "two numbers in [0, 1)", "e.g. [0.9,0.95]")
        if not self.learning_rate > 0:
            raise ConfigError(f"learning_rate={self.learning_rate}", "a positive number", "raise it")


@dataclass(frozen=True)
class Recipe:
    """One experiment.

    Args:
        title: one line.
        generator: name of the generator in lidargrit.generators.
        model: the generator's own configuration.
        data: which scans.
        training: how each stage of the generator learns.
        seed: of everything random.
        published: what the paper reports for it, for the reader; empty if this is not an experiment of the paper.
        tokenizer_from: folder of a finished run whose tokenizer is taken as it is, in place of training one.
    """

    title: str
    generator: str
    model: Any
    data: DataConfig
    training: dict[str, FitConfig]
    seed: int = 0
    published: str = ""
    tokenizer_from: str | None = None

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ConfigError(f"seed={self.seed}", "0 or more", "choose another seed")

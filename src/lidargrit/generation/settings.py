"""An experiment as settings: its data, its model, and the training of each of its stages."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from lidargrit.core.configuration import Settings
from lidargrit.core.errors import ConfigError
from lidargrit.core.typed_values import Bounds, Count, NotNegative, Positive, ShareBelow1, Weight
from lidargrit.data.prepared.config import DataConfig
from lidargrit.generation.generator import Generator, load_class
from lidargrit.nn.precision import Precision
from lidargrit.nn.size import numbers_at_most
from lidargrit.scans.augmentation import Augmentation
from lidargrit.scans.sensors import SensorModel

_FROZEN = "frozen:"
_BATCH_AT_MOST = 65_536  # scans: 4 GB of the smallest images, and more than any step learns from


@dataclass(frozen=True)
class TrainingConfig(Settings):
    """How one stage of a generator is trained; every duration is a number of scans seen.

    Args:
        scans: number of scans seen over the whole training of the stage.
        batch_size: number of scans in a batch, over all processes.
        accumulate: number of parts in which each process takes its share of a batch, one after the other. More parts
            need less memory. The step is the same in expectation: each part has random numbers of its own, a loss that
            is divided by the returns of a batch is divided by those of a part, and codes move or restart after a part.
        learning_rate: highest learning rate.
        schedule: course of the learning rate. ``constant``; ``cosine`` falls to 0 over all scans;
            ``linear_second_half`` stays constant for the first half and falls to 0 over the second, as LidarGRIT's
            program does for its KITTI-360 transformer.
        warmup_scans: number of scans over which the learning rate rises linearly from 0.
        optimiser: ``adamw``, as in all papers here, or ``muon``: Muon for the linear layers and convolutions in blocks,
            whose updates it makes orthogonal (Jordan et al., 2024), and AdamW for all other weights. Transformers and
            pixel decoders learn more from equally many scans with it.
        betas: decay rates of Adam's two moments.
        weight_decay: decay of the weights of linear layers; other weights do not decay, as in LidarGRIT's program.
        gradient_clip: largest norm of the gradient; 0 for no limit.
        average_over_scans: half-life, in scans, of the moving average of the weights; the averaged weights are
            validated and become the model. 0 for no averaging.
        precision: ``bf16`` computes convolutions and matrix products in 16 bits, sums and losses in 32. ``auto`` does
            so where the machine has instructions for it; elsewhere 16 bits are many times slower. ``tf32`` rounds what
            a GPU multiplies to 11 digits; ``fp32`` rounds nothing.
        recompute: whether to drop the activations within blocks and compute them again for the gradients: less memory,
            the same gradients, about a third more operations.
        compile: whether to use ``torch.compile``, which needs a C++ compiler, and minutes before the first step.
        augmentations: kinds of augmentation, applied in this order; see lidargrit.scans.augmentation.
        any_columns: whether an image may begin at any of the first n fine columns where the sensor keeps every n-th,
            so that each scan gives n different images. LidarGRIT's program always begins at the first.
        validate_every: number of scans between two validations.
        validation_scans: largest number of scans in a validation, evenly spaced over the validation set.
        checkpoint_every: number of scans between two checkpoints.
        pictures_every: number of scans between two pictures of reconstructed or sampled scans; 0 for none.
        start: finished run with the stage, whose weights are trained further; ``frozen:RUN`` uses them as they are and
            trains nothing. If empty, training begins with new weights.
    """

    scans: Count
    batch_size: Annotated[int, Bounds(1, _BATCH_AT_MOST)]
    learning_rate: Positive
    schedule: Literal["constant", "cosine", "linear_second_half"] = "constant"
    warmup_scans: NotNegative = 0
    optimiser: Literal["adamw", "muon"] = "adamw"
    betas: tuple[ShareBelow1, ShareBelow1] = (0.9, 0.95)
    weight_decay: Weight = 0.0
    gradient_clip: Weight = 1.0
    average_over_scans: NotNegative = 1000
    accumulate: Count = 1
    precision: Precision = "fp32"
    recompute: bool = False
    compile: bool = False
    augmentations: tuple[Augmentation, ...] = ()
    any_columns: bool = False
    validate_every: Count = 1000
    validation_scans: Count = 64
    checkpoint_every: Count = 1000
    pictures_every: NotNegative = 0
    start: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.start == _FROZEN:  # not the current folder
            raise ConfigError(f"start={_FROZEN}", "frozen:RUN, RUN, or nothing for new weights", "name the run")

    @property
    def frozen(self) -> bool:
        """Whether the stage is not trained: the weights of another run are used as they are."""
        return self.start.startswith(_FROZEN)

    @property
    def start_run(self) -> str:
        """Run whose weights of the stage are taken; "" for new weights."""
        return self.start.removeprefix(_FROZEN)


@dataclass(frozen=True)
class Preset(Settings):
    """One experiment.

    Args:
        title: description of the experiment in one line.
        generator: name of the generator, a folder of lidargrit.systems.
        model: configuration of the generator, of its own ``Config`` class.
        training: settings of the training, by the name of the stage.
        seed: seed of everything random: weights, order, augmentation, dropout.
        published: scores that a paper reports for the experiment, for the reader; empty if no paper does.
    """

    title: str
    generator: str
    model: Any
    data: DataConfig
    training: dict[str, TrainingConfig]
    seed: NotNegative = 0
    published: str = ""

    @property
    def start_runs(self) -> dict[str, str]:
        """Run whose weights a stage starts from or uses as they are, by the name of the stage."""
        return {stage: config.start_run for stage, config in self.training.items() if config.start}

    @property
    def frozen(self) -> dict[str, str]:
        """Run whose weights a stage uses as they are, by the name of the stage."""
        return {stage: run for stage, run in self.start_runs.items() if self.training[stage].frozen}

    def settings_of(self, stage: str) -> TrainingConfig:
        """Return the settings of a stage's training."""
        if stage not in self.training:
            raise ConfigError(
                f"a preset without training.{stage}, a stage of model={self.generator}",
                "the settings of every stage's training",
                f"leave out the model.* that adds {stage}, or begin with a preset that trains it",
            )
        return self.training[stage]

    def build_generator(self, sensor: SensorModel | None = None) -> Generator:
        """Return the generator with new random weights.

        Args:
            sensor: sensor of its scans; that of the data if not given.

        Raises:
            ConfigError: the generator does not fit the sensor, or is too large.
        """
        with numbers_at_most():
            return load_class(self.generator)(self.model, sensor or self.data.load_sensor())

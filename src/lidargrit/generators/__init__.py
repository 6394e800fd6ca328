"""Noise → range images: the contract of a generator, and how one is written to a folder and read back."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from torch import Tensor, nn

from lidargrit import _discovery, configuration
from lidargrit.errors import CheckpointError, ConfigError, LidarGritError
from lidargrit.files import load_exactly, read_json, read_tensors, write_json, write_tensors
from lidargrit.loading import RangeImages
from lidargrit.sensors import SensorModel
from lidargrit.structures import RangeImage
from lidargrit.tokenizers import MaskDecoding

CONFIG_FILE, WEIGHTS_FILE = "config.json", "model.safetensors"
TRAINED_ON_FILE = "trained_on.json"  # in a run's folder and beside its samples: which drives, which pixels


@dataclass(frozen=True)
class SamplingConfig:
    """How scans are drawn.

    Args:
        temperature: above 1 bolder, below 1 safer than the model's own probabilities; 0 takes the likeliest token.
        top_k: draw among the k likeliest tokens only; 0 for all, the model's own distribution, since the paper names no
            other. The released program's is 100, which makes a barely trained model bland.
        top_p: draw among the likeliest tokens that together hold this probability; 1 for all.
        mask: ``bernoulli`` draws each return with its probability (the released program, so what the paper's scores
            were computed with); ``threshold`` keeps what is at least as likely as not (the paper's eq. 1).
    """

    temperature: float = 1.0
    top_k: int = 0
    top_p: float = 1.0
    mask: MaskDecoding = "bernoulli"

    def __post_init__(self) -> None:
        if not (self.temperature >= 0 and self.top_k >= 0 and 0 < self.top_p <= 1):
            raise ConfigError(
                f"temperature={self.temperature}, top_k={self.top_k}, top_p={self.top_p}",
                "temperature >= 0, top_k >= 0, 0 < top_p <= 1",
                "correct the one that is out of bounds",
            )


class Generator(nn.Module, ABC):
    """A system that writes new scans of one sensor.

    It is made of ``Config`` and a sensor, and trained in ``stages``, one after the other, each by its own objective.
    """

    Config: ClassVar[type]
    stages: ClassVar[tuple[str, ...]]
    sensor: SensorModel
    config: Any

    @abstractmethod
    def __init__(self, config: Any, sensor: SensorModel) -> None:
        super().__init__()

    def learn(self, images: RangeImages) -> None:
        """Take from the training scans what needs no objective, such as counts; called once, before the stages."""

    @abstractmethod
    def objective(self, stage: str) -> nn.Module:
        """Return what a stage trains: a module (images, rng) → terms with ``loss``; its weights are ours."""

    @abstractmethod
    def finish(self, stage: str, objective: nn.Module) -> None:
        """Take over the weights of a stage's trained objective."""

    @abstractmethod
    def sample(self, seeds: Sequence[int], sampling: SamplingConfig | None = None) -> RangeImage:
        """Write one scan for each seed; a seed gives the same scan whatever the others are.

        Example::

            lidargrit.load("runs/demo").sample(seeds=[0, 1, 2, 3])
        """

    def save(self, folder: Path) -> None:
        """Write the weights and, last, the configuration that says they are there."""
        write_tensors(folder / WEIGHTS_FILE, self.state_dict())
        name = type(self).__module__.rpartition(".")[2]
        config = {"generator": name, "config": configuration.to_json(self.config), "sensor": self.sensor.to_json()}
        write_json(folder / CONFIG_FILE, config)

    @classmethod
    def from_weights(cls, config: Any, sensor: SensorModel, weights: dict[str, Tensor], source: Path) -> Generator:
        """Make a generator with given weights.

        Raises:
            CheckpointError: weights of another configuration.
        """
        generator = cls(config, sensor)
        load_exactly(generator, weights, source)
        return generator.eval()


def is_run(folder: Path) -> bool:
    """Tell whether a folder is that of a finished run."""
    return (folder / CONFIG_FILE).is_file()


def load(folder: str | Path) -> Generator:
    """Read a trained generator from a run's folder.

    Raises:
        CheckpointError: no finished model in the folder, a damaged file, or weights of another configuration.
    """
    folder = Path(folder)
    if not is_run(folder):
        raise CheckpointError(
            f"{folder}, which holds no finished model",
            f"a run's folder with {CONFIG_FILE} and {WEIGHTS_FILE}",
            "finish the training (the same command goes on), or check the path",
        )
    about = read_json(folder / CONFIG_FILE)
    try:
        config, sensor = about["config"], SensorModel.from_json(about["sensor"])
        cls = load_class(str(about["generator"]))
    except ConfigError as error:
        raise CheckpointError(
            f"{folder / CONFIG_FILE}, in which {error.got}", error.wanted, "restore the file"
        ) from None
    except LidarGritError:
        raise
    except (KeyError, TypeError, ValueError) as error:  # the last from tables that are not rectangular
        raise CheckpointError(
            f"{folder / CONFIG_FILE}, which cannot be used ({error})", "what lidargrit wrote", "restore the file"
        ) from None
    config = configuration.from_json(cls.Config, config, str(folder / CONFIG_FILE))
    return cls.from_weights(config, sensor, read_tensors(folder / WEIGHTS_FILE)[0], folder / WEIGHTS_FILE)


def load_class(name: str) -> type[Generator]:
    """Return the generator class of a name, or raise UnknownNameError."""
    return _discovery.load_class("generators", name, Generator)

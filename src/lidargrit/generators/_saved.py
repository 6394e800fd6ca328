"""A network with its configuration and sensor ⇄ the two files in which it is saved."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

from torch import Tensor, nn

from lidargrit import configuration
from lidargrit.errors import ConfigError
from lidargrit.files import load_exactly, write_json, write_tensors, write_text
from lidargrit.nn.phase_noise import PhaseNoise
from lidargrit.run_folder import CARD_FILE, CONFIG_FILE, WEIGHTS_FILE
from lidargrit.sensors import SensorModel

ConfigT = TypeVar("ConfigT")
ModelT = TypeVar("ModelT", bound=nn.Module)


class SavedModel(nn.Module, Generic[ConfigT]):
    """A network that is made from a configuration and a sensor, and that can be written to a folder.

    Args:
        config: settings of the network, an instance of ``Config``.
        sensor: sensor whose range images the network takes or generates.
    """

    Config: ClassVar[type]

    def __init__(self, config: ConfigT, sensor: SensorModel) -> None:
        super().__init__()
        self.config, self.sensor = config, sensor

    @classmethod
    def public_name(cls) -> str:
        """Return the name of the file that defines the class."""
        return cls.__module__.rpartition(".")[2]

    def weights(self, half: bool = False) -> dict[str, Tensor]:
        """Return the tensors that are saved, by name.

        Args:
            half: whether parameters, but no buffers, are rounded to 16 bits; a network that reads them computes in 32
                bits as before.

        Raises:
            ConfigError: a parameter is beyond what 16 bits hold.
        """
        halved = {name: weight.detach().half() for name, weight in self.named_parameters()} if half else {}
        for name, weight in halved.items():
            if not weight.isfinite().all():
                largest = self.get_parameter(name).abs().max()
                raise ConfigError(f"weights {name!r} of up to {largest:g}", "at most 65,504", "leave half out")
        return {**self.state_dict(), **halved}

    def save(self, folder: Path, half: bool = False) -> None:
        """Write :meth:`weights` and, last, the configuration that says they are there."""
        write_tensors(folder / WEIGHTS_FILE, self.weights(half))
        config = {
            "generator": self.public_name(),
            "config": configuration.to_json(self.config),
            "sensor": self.sensor.to_json(),
        }
        write_json(folder / CONFIG_FILE, config)

    @classmethod
    def from_weights(
        cls: type[ModelT], config: Any, sensor: SensorModel, weights: dict[str, Tensor], source: Path
    ) -> ModelT:
        """Make a generator with given weights.

        Raises:
            CheckpointError: weights of another configuration.
        """
        generator = cls(config, sensor)
        load_exactly(generator, weights, source, PhaseNoise.names_in(generator))
        return generator.eval()

    def save_pretrained(self, folder: str | Path, card: str = "", half: bool = False) -> None:
        """Write what a repository of the Hugging Face hub holds: weights, configuration, and a model card if given.

        These are the files of :meth:`save`. ``lidargrit publish`` writes the card from a run.

        Args:
            folder: folder that gets the files.
            card: text of ``README.md``, in Markdown; no such file if empty.
            half: whether parameters are rounded to 16 bits; see :meth:`weights`.
        """
        self.save(Path(folder), half)
        if card:
            write_text(Path(folder) / CARD_FILE, card)

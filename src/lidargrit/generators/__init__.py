"""Noise → range images: the contract of a generator, and how one is written to a folder and read back."""

from __future__ import annotations

import importlib
import re
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar

from jaxtyping import Bool, Float
from torch import Tensor, nn

from lidargrit import _discovery, configuration
from lidargrit.errors import CheckpointError, ConfigError, LidarGritError
from lidargrit.files import is_taken, load_exactly, read_json, read_tensors, write_json, write_tensors, write_text
from lidargrit.loading import RangeImages
from lidargrit.nn.objective import Objective
from lidargrit.nn.size import numbers_at_most
from lidargrit.sensors import SensorModel
from lidargrit.structures import RangeImage
from lidargrit.tokenizers import Tokenizer

CONFIG_FILE, WEIGHTS_FILE, CARD_FILE = "config.json", "model.safetensors", "README.md"  # the names that the hub knows
RUN_FILE = "run.json"  # ``origin`` in it says that the weights beside it were not trained in this folder
TRAINED_ON_FILE = "trained_on.json"  # in a run's folder and beside its samples: which drives, which pixels
PRETRAINED = Path(__file__).parents[1] / "pretrained"
"""The run that comes with the package; by the folder's name it goes wherever a run is wanted."""


@dataclass(frozen=True)
class NoSampling:
    """Of a generator that leaves nothing to choose when scans are drawn."""


@dataclass(frozen=True)
class Cost:
    """What drawing one scan takes, counted and not timed, so the same on every machine.

    Args:
        network_evaluations: passes through a network, one after the other.
        flops: floating-point operations of products and convolutions, two for each multiplication with its addition.
    """

    network_evaluations: int
    flops: int


CAPABILITIES = {  # name → what a generator that declares it can do besides sampling, for people
    "tokens": "turn scans into tokens and back",
    "encode": "give scans back from a code of its own",
    "complete": "fill in the pixels of a scan that were not observed",
    "invert": "search the scan nearest to a given one among those it can write",
    "likelihood": "tell how likely a scan is",
}


class Generator(nn.Module, ABC):
    """A system that writes new scans of one sensor.

    It is made of ``Config`` and a sensor, and trained in ``stages``, one after the other, each by its own objective.
    Every one can ``sample``, by the choices of its ``Sampling``. What else it can do, it declares in ``capabilities``;
    asked for anything beyond them, it says which generators can.
    """

    Config: ClassVar[type]
    Sampling: ClassVar[type] = NoSampling
    stages: ClassVar[tuple[str, ...]]
    capabilities: ClassVar[frozenset[str]] = frozenset()
    published_files: ClassVar[tuple[str, ...]] = ()
    """What the files hold that the system's authors published its weights in, in order; none if we read none."""
    sensor: SensorModel
    config: Any

    @abstractmethod
    def __init__(self, config: Any, sensor: SensorModel) -> None:
        super().__init__()

    def fit_statistics(self, images: RangeImages) -> None:
        """Take from the training scans what needs no objective, such as counts; called once, before the stages."""

    @abstractmethod
    def objective(self, stage: str) -> Objective:
        """Return what a stage trains: a module (images, rng) → terms with ``loss``; its weights are ours."""

    @abstractmethod
    def load_stage(self, stage: str, objective: Objective) -> None:
        """Take over the weights of a stage's trained objective."""

    @abstractmethod
    def sample(self, seeds: Sequence[int], sampling: Any = None) -> RangeImage:
        """Write one scan for each seed; a seed gives the same scan whatever the others are.

        Args:
            seeds: one a scan.
            sampling: choices, of the generator's own ``Sampling``; its defaults if not given.

        Example::

            lidargrit.load("runs/demo").sample(seeds=[0, 1, 2, 3])
        """

    def stream(self, seeds: Iterable[int], sampling: Any = None, batch_size: int = 8) -> Iterator[RangeImage]:
        """Yield one scan for each seed, drawn so many at once; nothing is kept, so seeds may be without end.

        Args:
            seeds: one a scan, such as ``itertools.count(0)``.
            sampling: as for :meth:`sample`.
            batch_size: the scans do not depend on it.
        """
        remaining = iter(seeds)
        while some := list(islice(remaining, batch_size)):
            images = self.sample(some, sampling)
            yield from (images[index] for index in range(len(images)))

    @abstractmethod
    def cost(self, sampling: Any = None) -> Cost:
        """Return what drawing one scan takes."""

    def get_tokenizer(self) -> Tokenizer:
        """Return the tokenizer whose tokens the generator writes (``tokens``)."""
        raise self._cannot("tokens")

    def reconstruct(self, images: RangeImage) -> RangeImage:
        """Return what the generator's code keeps of a batch of scans (``encode``)."""
        raise self._cannot("encode")

    def complete(
        self, images: RangeImage, observed: Bool[Tensor, "B H W"], seeds: Sequence[int], sampling: Any = None
    ) -> RangeImage:
        """Return scans that agree with what was observed and make up the rest (``complete``).

        Args:
            images: (B, H, W); what they hold where nothing was observed is not looked at.
            observed: where they are known, be it a return or that there was none.
            seeds: one for each image.
            sampling: choices; the defaults if not given.
        """
        raise self._cannot("complete")

    def invert(self, images: RangeImage, seeds: Sequence[int], sampling: Any = None) -> RangeImage:
        """Return for each scan the nearest that the generator can write, as far as a search from a seed finds it."""
        raise self._cannot("invert")

    def log_likelihood(self, images: RangeImage) -> Float[Tensor, "B"]:
        """Return the log-likelihood of each scan in nats (``likelihood``).

        It is that of the generator's own representation of a scan, such as its tokens: systems do not compare by it.
        """
        raise self._cannot("likelihood")

    def _cannot(self, capability: str) -> ConfigError:
        able = [name for name in _discovery.names("generators") if capability in load_class(name).capabilities]
        return ConfigError(
            f"a generator {self.public_name()!r}, which cannot {CAPABILITIES[capability]}",
            f"one that can: {', '.join(able) or 'none of ours'}",
            "see what each can do with: lidargrit list generators",
        )

    @classmethod
    def about(cls) -> list[str]:
        """Return what the generator can do, and the choices of its sampling with their defaults, for people."""
        facts = [f"can {told} ({name})" for name, told in CAPABILITIES.items() if name in cls.capabilities]
        settings = [f"{name}={value}" for name, value in configuration.leaves(cls.Sampling()).items()]
        return [*facts, f"sample --set: {', '.join(settings)}"] if settings else facts

    @classmethod
    def public_name(cls) -> str:
        """Return the name of the file that defines the class."""
        return cls.__module__.rpartition(".")[2]

    def weights(self, half: bool = False) -> dict[str, Tensor]:
        """Return what is saved of the networks.

        Args:
            half: round parameters, but no buffers, to 16 bits; networks that are read again compute in 32 as before.

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
    def from_weights(cls, config: Any, sensor: SensorModel, weights: dict[str, Tensor], source: Path) -> Generator:
        """Make a generator with given weights.

        Raises:
            CheckpointError: weights of another configuration.
        """
        generator = cls(config, sensor)
        load_exactly(generator, weights, source)
        return generator.eval()

    @classmethod
    def from_published(cls, files: Sequence[Path], config: Any, sensor: SensorModel) -> Generator:
        """Make a generator with the weights that the system's authors published, or that their program saved.

        Args:
            files: as many as ``published_files``, in that order; code in them is not run.
            config: sizes, where the files do not tell them.
            sensor: whose rays their images have.

        Raises:
            CheckpointError: other files, or weights of other sizes.
        """
        able = [name for name in _discovery.names("generators") if load_class(name).published_files]
        raise ConfigError(
            f"a generator {cls.public_name()!r}, of which nobody published weights",
            f"a recipe of {', '.join(able)}",
            "see which generator a recipe has with: lidargrit train RECIPE OUT --dry-run",
        )

    def save_pretrained(self, folder: str | Path, card: str = "", half: bool = False) -> None:
        """Write what a repository of the Hugging Face hub holds: weights, configuration, and a model card if given.

        These are the files of :meth:`save`. ``lidargrit publish`` writes the card from a run.

        Args:
            folder: for the files.
            card: Markdown, for ``README.md``.
            half: as for :meth:`weights`.
        """
        self.save(Path(folder), half)
        if card:
            write_text(Path(folder) / CARD_FILE, card)

    @classmethod
    def from_pretrained(cls, name: str | Path, revision: str | None = None) -> Generator:
        """Read a generator from a folder, or from a repository of the Hugging Face hub.

        Args:
            name: of a run's or a published folder, or "USER/REPOSITORY" if no such folder is there.
            revision: of the repository: a branch, a tag or a commit.

        Raises:
            CheckpointError: no such folder or repository, a damaged one, or another kind of generator in it.
        """
        here = locate(name)
        generator = load(here if here.is_dir() else _downloaded(str(name), revision))
        if not isinstance(generator, cls):
            raise CheckpointError(
                f"{name}, which holds a generator {generator.public_name()!r}",
                f"one of {cls.public_name()!r}",
                "read it with Generator.from_pretrained",
            )
        return generator


def locate(run: str | Path) -> Path:
    """Return the folder of a run; for the word ``pretrained`` that of the package, unless you have one."""
    return PRETRAINED if str(run) == PRETRAINED.name and not is_taken(Path(run)) else Path(run)


def is_run(folder: Path) -> bool:
    """Tell whether a folder is that of a finished run."""
    return (folder / CONFIG_FILE).is_file()


def recipe_settings(about: Any) -> dict[str, Any]:
    """Return every setting of the recipe in a ``run.json`` by its name of today; none where there is no recipe."""
    return configuration.leaves(about.get("recipe") if isinstance(about, dict) else {})


def load(folder: str | Path) -> Generator:
    """Read a trained generator from a run's folder; ``pretrained`` is the one that comes with the package.

    Raises:
        CheckpointError: no finished model in the folder, a damaged file, or weights of another configuration.
    """
    folder = locate(folder)
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
    weights = read_tensors(folder / WEIGHTS_FILE)[0]
    expected = sum(tensor.numel() for tensor in weights.values())
    # Twice as many as the file holds, for what is built besides: a wrong file is refused before it fills the memory.
    with numbers_at_most(2 * expected + 2**20, f"{folder / CONFIG_FILE} with a network", "restore both files"):
        return cls.from_weights(config, sensor, weights, folder / WEIGHTS_FILE)


def load_class(name: str) -> type[Generator]:
    """Return the generator class of a name, or raise UnknownNameError."""
    return _discovery.load_class("generators", name, Generator)


def _downloaded(name: str, revision: str | None) -> Path:
    """Fetch the files of a repository by the hub's own client, which keeps them in its cache."""
    wanted, cure = "a run's folder, or USER/REPOSITORY on the Hugging Face hub", "check the name"
    if not re.fullmatch(r"[\w.-]+/[\w.-]+", name):
        raise CheckpointError(f"{name}, which is no folder", wanted, cure)
    try:
        hub = importlib.import_module("huggingface_hub")  # an extra: nothing else needs it
        return Path(hub.snapshot_download(name, revision=revision, allow_patterns=["*.json", WEIGHTS_FILE]))
    except ImportError:
        got, cure = f"{name}, which is no folder here", "to fetch it from the hub: pip install 'lidargrit[hub]'"
    except Exception as error:  # its client has a dozen kinds, from a wrong name to a broken line, and changes them
        got = f"{name}, which cannot be fetched ({type(error).__name__}: {str(error).partition(chr(10))[0][:100]})"
    raise CheckpointError(got, wanted, cure)

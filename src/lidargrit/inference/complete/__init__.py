"""What completes scans: the name of a run or of a classical method → an object that generates unobserved pixels."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Generic

from lidargrit.core.configuration import name_and_settings
from lidargrit.core.errors import ConfigError, nearest_names
from lidargrit.data.images import Provenance
from lidargrit.data.run_folder import PACKAGED, locate, projection_variant, trained_on
from lidargrit.generation.generator import Generator, SamplingT, load
from lidargrit.inference.samples import sampling_identity
from lidargrit.nn.devices import usable_device
from lidargrit.scans.condition import KINDS, Condition, ConditionKind
from lidargrit.scans.fills import FILLS, fill
from lidargrit.scans.projection import ProjectionVariant
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage


class Completer(ABC):
    """Whatever completes scans, learned or not.

    Args:
        name: word by which the user named it.
        sensor: sensor of the scans that it completes.
    """

    def __init__(self, name: str, sensor: SensorModel) -> None:
        self.name, self.sensor = name, sensor

    random: bool
    """Whether two seeds give two completions."""
    batch: int = 1
    """Number of scans that are best completed at once."""
    projection_variant: ProjectionVariant = "exact"
    """Variant by which scans become range images."""

    @abstractmethod
    def complete(self, condition: Condition, seeds: Sequence[int]) -> RangeImage:
        """Return scans that keep what was observed, one for each seed."""

    @abstractmethod
    def takes(self) -> frozenset[ConditionKind]:
        """Return the kinds of conditions that it accepts."""

    def learned_from(self) -> Provenance:
        """Return the training scans; none of a classical method."""
        return Provenance()

    @abstractmethod
    def identity(self) -> dict[str, Any]:
        """Return entries for a file by which its completions are told from those of other models or settings."""


class ClassicalCompleter(Completer):
    """A method without a network; it completes scans of any sensor, always in the same way."""

    random = False

    def complete(self, condition: Condition, seeds: Sequence[int]) -> RangeImage:
        """Return the scans, filled in from their observed returns."""
        return fill(self.name, condition)

    def takes(self) -> frozenset[ConditionKind]:
        """Return known pixels."""
        return frozenset({"pixels"})

    def identity(self) -> dict[str, Any]:
        """Return its name."""
        return {"model": self.name, "sensor": self.sensor.to_json()}


class LearnedCompleter(Completer, Generic[SamplingT]):
    """The generator of a finished run.

    Args:
        name: word by which the user named the run.
        folder: folder of the run.
        generator: generator of the run.
        sampling: settings by which it completes.
    """

    random = True

    def __init__(self, name: str, folder: Path, generator: Generator[Any, SamplingT], sampling: SamplingT) -> None:
        super().__init__(name, generator.sensor)
        self._folder, self._generator, self._sampling = folder, generator, sampling
        self.batch = generator.compute_batch
        self.projection_variant = projection_variant(folder)

    def complete(self, condition: Condition, seeds: Sequence[int]) -> RangeImage:
        """Return what the generator makes of the conditions, in the computer's memory."""
        return self._generator.complete(condition, seeds, self._sampling).to("cpu")

    def takes(self) -> frozenset[ConditionKind]:
        """Return what the generator takes."""
        return self._generator.conditions

    def learned_from(self) -> Provenance:
        """Return the training scans of the run."""
        return trained_on(self._folder)

    def identity(self) -> dict[str, Any]:
        """Return the hash of its weights, its configuration, and the settings of sampling."""
        return sampling_identity(self._generator, self._folder, self._sampling)


def open_completer(
    word: str,
    kind: ConditionKind = "pixels",
    sensor: SensorModel | None = None,
    settings: Sequence[str] = (),
    device: str = "",
) -> Completer:
    """Return the model or the classical method that a user named.

    Args:
        word: folder of a run, ``pretrained``, or a classical method: nearest, linear or triangulation.
        kind: kind of the conditions that it will be given.
        sensor: sensor of the scans, which a classical method needs; a run has its own.
        settings: settings of the run's sampling, as NAME=VALUE.
        device: device of the run; a GPU if there is one and none is named.

    Raises:
        ConfigError: a run that cannot complete such scans, or one of another sensor than the named one.
    """
    if is_classical(word):
        if device:  # a typing error is refused, although nothing is computed there
            usable_device(device)
        if kind != "pixels":
            got = f"--model {word}, a classical method, which takes {KINDS['pixels']}"
            raise ConfigError(got, f"a run that takes {KINDS[kind]}", "name one, such as pretrained")
        if settings:
            raise ConfigError(f"--model {word} for --set {settings[0]}", "a run, such as pretrained", "name a run")
        if sensor is None:  # other verbs take that of the source
            got = f"--model {word}, a classical method, without the sensor of the scans that it writes"
            raise ConfigError(got, "its name or .json file", "name it with --to (in Python: sensor=...)")
        return ClassicalCompleter(word, sensor)
    folder = locate(word)
    if not folder.exists():
        known = [*(FILLS if kind == "pixels" else ()), *(one.name for one in PACKAGED)]
        raise ConfigError(
            f"--model {word}, which does not exist",
            f"a run's folder, or {nearest_names(word, known)}",
            "check the name",
        )
    generator = load(folder).to(usable_device(device))
    if kind not in generator.conditions:
        takes = " or ".join(KINDS[one] for one in sorted(generator.conditions)) or "no condition at all"
        raise ConfigError(
            f"--model {word}, of a generator {generator.public_name()!r} that takes {takes}",
            f"one that takes {KINDS[kind]}",
            "name another run, such as pretrained",
        )
    if sensor is not None and not generator.sensor.same_rays(sensor):
        own = f"{generator.sensor.name!r}, {generator.sensor.height}x{generator.sensor.width}"
        raise ConfigError(
            f"the sensor {sensor.name!r}, {sensor.height}x{sensor.width}, for --model {word}",
            f"its own, {own}",
            "leave the sensor out, or name another model",
        )
    return LearnedCompleter(word, folder, generator, generator.parse_sampling(settings, completing=True))


def open_completers(words: Sequence[str], sensor: SensorModel | None = None, device: str = "") -> list[Completer]:
    """Return several models and methods for a comparison on the same scans; methods get the sensor of the first run.

    Args:
        words: models and methods, each as in :func:`open_completer`; a run may bring settings, as in
            ``pretrained:completion=tokens``.
        sensor: sensor of the scans; needed only where there is no run among the words.
        device: device of the runs.
    """
    runs: dict[str, Completer] = {}
    for word in words:
        if not is_classical(word):
            folder, settings = name_and_settings(word)
            runs[word] = open_completer(folder, "pixels", sensor, settings, device)
            runs[word].name = word
    own = next((run.sensor for run in runs.values()), sensor)
    return [runs[word] if word in runs else open_completer(word, "pixels", own, device=device) for word in words]


def is_classical(word: str) -> bool:
    """Return whether a word names a classical method, unless a folder has that name."""
    return word in FILLS and not Path(word).exists()

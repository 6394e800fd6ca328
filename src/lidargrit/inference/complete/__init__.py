"""What completes scans: the name of a run or of a classical method → a generator, with the settings it completes by."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lidargrit.core import configuration
from lidargrit.core.configuration import name_and_settings
from lidargrit.core.errors import ConfigError, UnknownNameError, nearest_names, one_of
from lidargrit.data.images import Provenance
from lidargrit.data.run_folder import PACKAGED, Job, locate, projection_variant, takes_any_sensor, trained_on
from lidargrit.data.sources.scan_sensor import other_sensor
from lidargrit.generation.facts import SamplingSettings
from lidargrit.generation.generator import Generator, load, load_class
from lidargrit.inference.samples import sampling_identity
from lidargrit.nn.devices import usable_device
from lidargrit.scans.condition import KINDS, ConditionKind, Observed
from lidargrit.scans.fills import FILLS
from lidargrit.scans.projection import ProjectionVariant
from lidargrit.scans.sensors import ProjectionOption, SensorModel
from lidargrit.scans.types import RangeImage

_JOBS: dict[ConditionKind, Job] = {"pixels": "complete", "surfaces": "raydrop"}


@dataclass(frozen=True, eq=False)
class Model:
    """A generator that a user named, to complete scans by.

    Args:
        generator: generator of a run, or a classical method.
        folder: folder of its run; None for a classical method.
        projection: way in which points find their rows; ``sensor`` for the sensor's own, or what fits the points.
    """

    name: str
    generator: Generator[Any, Any]
    sampling: SamplingSettings | None
    folder: Path | None = None
    projection: ProjectionOption = "sensor"

    @property
    def sensor(self) -> SensorModel:
        """Sensor of the scans that it completes."""
        return self.generator.sensor

    @property
    def projection_variant(self) -> ProjectionVariant:
        """Variant by which scans become range images."""
        return "exact" if self.folder is None else projection_variant(self.folder)

    @property
    def batch_size(self) -> int:
        """Number of range images that the generator completes at once."""
        return self.generator.batch_size(self.sampling)

    def complete(self, condition: Observed, seeds: Sequence[int]) -> RangeImage:
        """Return scans that keep what was observed, one for each seed, in the computer's memory."""
        return RangeImage.stack([image.to("cpu") for image in self.generator.stream(seeds, self.sampling, condition)])

    def learned_from(self) -> Provenance:
        """Return the training scans; none of a classical method."""
        return Provenance() if self.folder is None else trained_on(self.folder)

    def identity(self) -> dict[str, Any]:
        """Return entries for a file by which its completions are told from those of other models or settings."""
        if self.folder is not None:
            return sampling_identity(self.generator, self.folder, self.sampling)
        return {"model": self.name, "sensor": self.sensor.to_json()}


def open_model(
    word: str | Path,
    kind: ConditionKind = "pixels",
    sensor: SensorModel | None = None,
    settings: Sequence[str] = (),
    device: str = "",
) -> Model:
    """Return the model or the classical method that a user named; of a bundle, the run which does the job.

    Args:
        word: folder of a run or of a bundle, ``pretrained``, or a classical method: nearest, linear or triangulation.
        kind: kind of the conditions that it will be given.
        sensor: sensor of the scans, which a classical method needs; a run has its own, unless it takes any.
        settings: settings of the run's sampling, as NAME=VALUE.

    Raises:
        ConfigError: a run that cannot complete such scans, or one of another sensor than the named one.
    """
    word = str(word)
    if kind not in KINDS:
        raise UnknownNameError(f"the kind of conditions {kind!r}", one_of([*KINDS]), "choose one")
    if is_classical(word):
        if kind != "pixels":
            got = f"--model {word}, a classical method, which takes {KINDS['pixels']}"
            raise ConfigError(got, f"a run that takes {KINDS[kind]}", "name one, such as pretrained")
        if settings:
            raise ConfigError(f"--model {word} for --set {settings[0]}", "a run, such as pretrained", "name a run")
        if sensor is None:  # other verbs take that of the source
            got = f"--model {word}, a classical method, without the sensor of the scans that it writes"
            raise ConfigError(got, "its name or .json file", "name it with --to (in Python: sensor=...)")
        folder, cls = None, load_class("interpolation")
        generator = cls(configuration.override(cls.Config(), [f"method={word}"]), sensor)
    else:
        folder = locate(word, _JOBS[kind])
        if not folder.exists():
            known = [*(FILLS if kind == "pixels" else ()), *(one.name for one in PACKAGED)]
            wanted = f"a run's folder, or {nearest_names(word, known)}"
            raise ConfigError(f"--model {word}, which does not exist", wanted, "check the name")
        generator = load(folder)
        if sensor is not None and takes_any_sensor(folder):
            generator = generator.for_sensor(sensor)
    generator = generator.to(usable_device(device))
    if kind not in generator.conditions:
        takes = " or ".join(KINDS[one] for one in sorted(generator.conditions)) or "no condition at all"
        raise ConfigError(
            f"--model {word}, of a generator {generator.public_name()!r} that takes {takes}",
            f"one that takes {KINDS[kind]}",
            "name another run, such as pretrained",
        )
    if sensor is not None and not generator.sensor.same_rays(sensor):
        raise other_sensor(sensor, generator.sensor, word)
    return Model(word, generator, generator.parse_sampling(settings, completing=True), folder)


def open_models(words: Sequence[str], sensor: SensorModel | None = None, device: str = "") -> list[Model]:
    """Return several models and methods for a comparison on the same scans; methods get the sensor of the first run.

    Args:
        words: models and methods, each as in :func:`open_model`; a run may bring settings, as in
            ``runs/mine:temperature=0.9``.
        sensor: sensor of the scans; needed only where there is no run among the words.
    """
    runs: dict[str, Model] = {}
    for word in words:
        if not is_classical(word):
            folder, settings = name_and_settings(word)
            runs[word] = replace(open_model(folder, "pixels", sensor, settings, device), name=word)
    own = next((run.sensor for run in runs.values()), sensor)
    return [runs[word] if word in runs else open_model(word, "pixels", own, device=device) for word in words]


def is_classical(word: str) -> bool:
    """Return whether a word names a classical method, unless a folder has that name."""
    return word in FILLS and not Path(word).exists()

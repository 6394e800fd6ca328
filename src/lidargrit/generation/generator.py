"""Base class of generators: seeds → range images; saving to a folder, and loading."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import chain, islice
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar, final

import torch

from lidargrit.core import configuration, discovery
from lidargrit.core.errors import CheckpointError, ConfigError
from lidargrit.core.files import read_tensors
from lidargrit.data.images import RangeImages
from lidargrit.data.run_folder import (
    CONFIG_FILE,
    WEIGHTS_FILE,
    Job,
    is_bundle,
    locate,
    named_folder,
    read_config,
    told_of,
)
from lidargrit.generation.batches import BatchSeeds, check_condition, check_images, check_seeds, in_batches, one_by_one
from lidargrit.generation.facts import CAPABILITIES, Cost, SamplingSettings, SystemFacts
from lidargrit.generation.hub import located
from lidargrit.generation.objective import Objective
from lidargrit.generation.range_steps import RangeSteps
from lidargrit.generation.saved import Bundle, ConfigT, SavedModel
from lidargrit.generation.tokenizers import Tokenizer
from lidargrit.nn.devices import usable_device
from lidargrit.nn.precision import Precision, inference
from lidargrit.nn.quantization import without_quantized
from lidargrit.nn.size import numbers_at_most
from lidargrit.scans.bits import ScanBits
from lidargrit.scans.condition import NOTHING, Condition, ConditionKind, Nothing, Observed
from lidargrit.scans.past import Past
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage

SamplingT = TypeVar("SamplingT", bound=SamplingSettings)


class Generator(SavedModel[ConfigT], ABC, Generic[ConfigT, SamplingT]):
    """A system that generates new scans of one sensor.

    It is made from a ``Config`` and a sensor, and trained in ``stages``, one after the other, each by its own
    objective. Every generator can ``sample``, by the settings of its ``Sampling``. What else it can do is named in
    ``capabilities``; asked for more, it answers which generators can.

    The public methods check their arguments and form batches, the same for all. A subclass writes ``_sample``, and for
    its capabilities ``_complete``, ``_reconstruct``, ``_bits`` and ``get_tokenizer``; these get valid arguments on the
    generator's device, in evaluation mode and without gradients.
    """

    Sampling: ClassVar[type] = SamplingSettings
    not_of_sampling: ClassVar[frozenset[str]] = frozenset()
    """Names of those settings in ``Sampling`` that only completing a scan reads."""

    capabilities: ClassVar[frozenset[str]] = frozenset()
    own_batches: ClassVar[tuple[int, int]] = (1, 8)
    """Number of scans that are computed at once on a CPU, and on a GPU, where the caller names none."""
    is_random: ClassVar[bool] = True
    """Whether two seeds give two scans."""
    has_new_scans: ClassVar[bool] = True
    """Whether it samples scans of which nothing is known; else it only completes or labels those of others."""
    bundle: "Bundle[Generator[Any, Any]] | None" = None
    """Runs that complete scans in its place where it was read from a bundle."""
    facts: ClassVar[SystemFacts] = SystemFacts(generates="range images")
    training_precision: ClassVar[Precision] = "auto"
    """Precision in which stages are trained where no preset names one."""

    trains: ClassVar[tuple[tuple[str, ...], ...]] = ()
    """Stages of training in order, each with the names of the networks, here and in its objective, that it trains.

    A stage takes place if its networks are there. The objective may be the network itself.
    """

    @classmethod
    @abstractmethod
    def smallest_config(cls, sensor: SensorModel) -> ConfigT:
        """Return settings of networks as small as can be, for images whose rows and columns are multiples of 32."""

    @classmethod
    def quickest_sampling(cls) -> SamplingT:
        """Return the settings that take the least time to sample or complete, for tests and first trials."""
        return cls.Sampling()

    @classmethod
    def completion_sampling(cls) -> SamplingT:
        """Return the settings by which scans are completed if the caller names none."""
        return cls.Sampling()

    @classmethod
    @final
    def parse_sampling(cls, words: Iterable[str], completing: bool = False) -> SamplingT:
        """Return the settings by which it samples or completes, with those changed that words NAME=VALUE name.

        Raises:
            ConfigError: an unknown name, one that sampling does not read, or a value of another type.
        """
        verb, cure = ("completion" if completing else "sampling"), "see all with: lidargrit list generators"
        settings = cls.completion_sampling() if completing else cls.Sampling()
        unread = frozenset() if completing else cls.not_of_sampling
        return configuration.override(settings, words, f"{verb} with {cls.public_name()!r}", cure, unread)

    @property
    def takes(self) -> frozenset[type[Condition]]:
        """Types of conditions that :meth:`sample` takes; ``Nothing`` is among them if it has new scans to sample."""
        told = {Nothing: self.has_new_scans, Past: self.past_scans > 0, Observed: "complete" in self.capabilities}
        return frozenset(kind for kind, is_taken in told.items() if is_taken)

    @property
    def conditions(self) -> frozenset[ConditionKind]:
        """Kinds of observations that it completes scans from; they may depend on ``config``."""
        return frozenset({"pixels"} if "complete" in self.capabilities else set())

    @property
    def past_scans(self) -> int:
        """Number of scans before each in its drive that it is told in training, and afterwards; 0 if it takes no past.

        It may depend on ``config``.
        """
        return 0

    @property
    def stages(self) -> tuple[str, ...]:
        """Names of the stages of training, in their order; they may depend on ``config``."""
        there = dict(self.named_children()).keys()
        return tuple(stage for stage, *names in self.trains if there >= {*names})

    @property
    def full_rows(self) -> range | None:
        """Rows in which every ray returns, none in the others; None for a generator with raydrop."""
        return None

    def batch_size(self, sampling: SamplingT | None = None) -> int:
        """Return the number of scans computed at once, always: a seed gives the same scan whatever else is asked for.

        The last batch is filled up with copies, for kernels differ by its size.
        """
        asked_for = 0 if sampling is None else sampling.batch_size
        return asked_for or self.own_batches[self.device.type != "cpu"]

    @property
    def device(self) -> torch.device:
        """Device on which the weights lie and scans are computed."""
        return next((each.device for each in chain(self.parameters(), self.buffers())), torch.device("cpu"))

    def fit_statistics(self, images: RangeImages) -> None:
        """Compute statistics of the training scans that need no objective; called once, before the stages."""

    def objective(self, stage: str) -> Objective:
        """Return what a stage minimises; :meth:`load_stage` takes its trained weights."""
        raise NotImplementedError(f"{self.public_name()} has no stage {stage!r}")

    def load_stage(self, stage: str, objective: Objective) -> None:
        """Load the weights of a stage's trained objective."""
        for name in next(names for one, *names in self.trains if one == stage):
            network = self.get_submodule(name)
            trained = objective if type(objective) is type(network) else objective.get_submodule(name)
            network.load_state_dict(trained.state_dict())

    def after_training(self) -> None:
        """Fit what depends on all trained stages."""

    @final
    @inference()
    def sample(
        self, seeds: Sequence[int], condition: Condition = NOTHING, sampling: SamplingT | None = None
    ) -> RangeImage:
        """Generate one scan for each seed; a seed gives the same scan whatever the others are, bit for bit.

        What was observed of a scan is kept, bit for bit. Reflectance and labels that the generator does not write are
        filled in from observed returns; a batch has them if any of its scans has observed some. A generator that was
        read from a bundle leaves each scan to the bundle's run for what was observed of it, unless it is given settings
        of its own sampling.

        Args:
            seeds: seeds, one for each scan, from 0 to 2^32 - 1.
            condition: condition of a type in :attr:`takes`, of as many scans as seeds;
                ``Observed.of_pixels(images, observed)`` completes scans.
            sampling: settings of its own ``Sampling``; its defaults, or :meth:`completion_sampling`, if not given.

        Raises:
            ConfigError: wrong seeds or another number of them, or settings, rays or a condition of another generator.

        Example::

            lidargrit.load("runs/demo").sample(seeds=[0, 1, 2, 3])
        """
        self._check_condition(condition)
        check_seeds(seeds, None if isinstance(condition, Nothing) else len(condition))
        known = condition.to(self.device)
        self.eval()
        if isinstance(known, Observed):
            return self._completed(known, seeds, sampling)
        settings = self._settings(sampling, self.Sampling)
        made = in_batches(seeds, self.batch_size(settings), lambda at, some: self._sample(some, known[at], settings))
        return known.put_into(made)

    @final
    def complete(self, condition: Observed, seeds: Sequence[int], sampling: SamplingT | None = None) -> RangeImage:
        """Return scans that keep all observed values and generate the rest: :meth:`sample` with an ``Observed``."""
        return self.sample(seeds, condition, sampling)

    @final
    def stream(
        self, seeds: Iterable[int], sampling: SamplingT | None = None, condition: Condition = NOTHING
    ) -> Iterator[RangeImage]:
        """Yield the scans of :meth:`sample` one by one; seeds may be without end, such as ``itertools.count(0)``."""
        if not isinstance(condition, Nothing):  # whose scans are to be as many, before any is computed
            seeds = seeds if isinstance(seeds, Sequence) else list(islice(seeds, len(condition) + 1))
            check_seeds(seeds, len(condition))
        remaining, size = iter(seeds), self.batch_size(sampling)
        for number, some in enumerate(iter(lambda: list(islice(remaining, size)), [])):
            images = self.sample(some, condition[number * size : (number + 1) * size], sampling)
            yield from (images[index] for index in range(len(images)))

    @abstractmethod
    def cost(self, sampling: SamplingT | None = None) -> Cost:
        """Return the cost of sampling one scan."""

    def get_tokenizer(self) -> Tokenizer[Any]:
        """Return the tokenizer whose tokens the generator samples (capability ``tokens``)."""
        self._require("tokens")
        raise NotImplementedError

    @final
    @inference()
    def reconstruct(self, images: RangeImage) -> RangeImage:
        """Encode each scan and decode it again, by itself (capability ``encode``).

        Args:
            images: batch of range images (B, H, W).

        Raises:
            ConfigError: images of other rays, or a generator without the capability.
        """
        self._require("encode")
        check_images(images, self.sensor)
        self.eval()
        return RangeImage.cat([self._reconstruct(image) for image in one_by_one(images.to(self.device))])

    @final
    @inference()
    def bits(
        self, images: RangeImage, step_mm: int = 10, expected: bool = False, condition: Condition = NOTHING
    ) -> ScanBits:
        """Return the negative log-likelihood of each scan in bits, each computed by itself (capability ``likelihood``).

        It is exact for generators without tokens. With tokens it is an upper bound, since tokens other than the
        encoder's could stand for the same scan. Systems can be compared by the bits of whole scans
        (:attr:`ScanBits.is_whole`) at one step.

        Args:
            images: batch of range images (B, H, W).
            step_mm: step in whole millimetres that ranges are rounded to, as a real number has infinitely many bits.
            expected: whether the expected number of bits (the entropy) is computed, too, for :meth:`ScanBits.anomaly`.
            condition: condition of each scan, such as its past, for a generator whose likelihood depends on it.

        Raises:
            ConfigError: images of other rays, another step or condition, or a generator without the capability.
        """
        self._require("likelihood")
        check_images(images, self.sensor)
        steps = RangeSteps(self.sensor, step_mm)
        self.eval()
        rounded = one_by_one(steps.round(images.to(self.device)))
        if isinstance(condition, Nothing):
            return ScanBits.cat([self._bits(image, steps, expected) for image in rounded])
        self._check_condition(condition, len(images))
        each = zip(rounded, (condition.to(self.device)[[at]] for at in range(len(images))), strict=True)
        return ScanBits.cat([self._bits_given(image, known, steps, expected) for image, known in each])

    def _sample(self, seeds: BatchSeeds, condition: Condition, sampling: SamplingT) -> RangeImage:
        """Generate one scan for each seed of a batch; scans of copies at their end may be left out.

        The condition is of a type in :attr:`takes`, and no ``Observed``.
        """
        raise NotImplementedError

    def _complete(self, condition: Observed, seeds: BatchSeeds, sampling: SamplingT) -> RangeImage:
        """Generate scans that agree with the observed values, which the caller then puts in."""
        raise NotImplementedError

    def _reconstruct(self, images: RangeImage) -> RangeImage:
        raise NotImplementedError

    def _bits(self, images: RangeImage, steps: RangeSteps, expected: bool) -> ScanBits:
        raise NotImplementedError

    def _bits_given(self, images: RangeImage, condition: Condition, steps: RangeSteps, expected: bool) -> ScanBits:
        """Return the bits under a condition; a generator whose likelihood depends on one overrides it."""
        raise ConfigError(f"a condition for the likelihood of {self.public_name()!r}", "scans alone", "leave it out")

    def _check_condition(self, condition: Condition, count: int | None = None) -> None:
        if isinstance(condition, Observed):
            self._require("complete")
        named, command = self.public_name(), self.facts.first_command
        check_condition(condition, self.takes, self.conditions, self.sensor, named, command, count)

    def _completed(self, known: Observed, seeds: Sequence[int], sampling: SamplingT | None) -> RangeImage:
        """Complete each scan, by the bundle's run for what was observed of it if there is one."""
        from lidargrit.scans.fills import fill_lacking  # noqa: PLC0415  loads scipy, and only this needs it

        settings = self._settings(sampling, self.completion_sampling)
        bundle = self.bundle if sampling is None else None
        shares = [(None, [*range(len(seeds))])] if bundle is None else bundle.shares(known)
        found: dict[int, RangeImage] = {}
        for run, indices in shares:
            some, own = known[indices], [seeds[index] for index in indices]
            if run is None:
                size = self.batch_size(settings)
                part = in_batches(own, size, lambda at, of, some=some: self._complete(some[at], of, settings))
            else:
                part = run.to(self.device).sample(own, some)
            found |= {index: part[[at]] for at, index in enumerate(indices)}
        generated = RangeImage.cat([found[index] for index in range(len(seeds))])
        return known.put_into(fill_lacking(generated, known))

    def _settings(self, given: SamplingT | None, default: Callable[[], SamplingT]) -> SamplingT:
        if given is not None and not isinstance(given, self.Sampling):
            got, wanted = type(given).__name__, self.Sampling.__name__
            raise ConfigError(f"settings of type {got}", wanted, "make them with generator.Sampling(...)")
        return default() if given is None else given

    def _require(self, capability: str) -> None:
        if capability not in self.capabilities:
            able = [name for name in discovery.names("generators") if capability in load_class(name).capabilities]
            raise ConfigError(
                f"a generator {self.public_name()!r}, which cannot {CAPABILITIES[capability]}",
                f"one that can: {', '.join(able) or 'none of ours'}",
                "see what each can do with: lidargrit list generators",
            )

    @classmethod
    def about(cls) -> list[str]:
        """Return lines for a person: the system's facts, and the sampling settings with their defaults."""
        return cls.facts.lines(cls.capabilities, configuration.own_first(cls.Sampling()), cls.not_of_sampling)

    @classmethod
    def from_pretrained(
        cls,
        pretrained_model_name_or_path: str | Path,
        *,
        revision: str | None = None,
        force_download: bool = False,
        token: str | bool | None = None,
        cache_dir: str | Path | None = None,
        local_files_only: bool = False,
    ) -> "Generator[Any, Any]":
        """Read a generator from a folder, or from a repository of the Hugging Face hub.

        Its arguments are those of :func:`lidargrit.generation.hub.located`.

        Raises:
            CheckpointError: no such folder or repository, a damaged one, or another kind of generator in it.
        """
        name = pretrained_model_name_or_path
        generator = load(located(name, revision, force_download, token, cache_dir, local_files_only))
        if not isinstance(generator, cls):
            got, wanted = (f"a generator {each.public_name()!r}" for each in (generator, cls))
            raise CheckpointError(f"{name}, which holds {got}", wanted, "read it with Generator.from_pretrained")
        return generator


def load(name: str | Path, job: Job = "sample", device: str = "cpu") -> Generator[Any, Any]:
    """Read a trained generator from a run's folder; ``pretrained`` and ``pretrained_wide`` come with the package.

    Args:
        name: folder of a run, or of a bundle of runs.
        job: job of the run that is read from a bundle.
        device: name of the device that it computes on; with "", a GPU if there is one, and else the CPU.

    Raises:
        CheckpointError: no finished model in the folder, a damaged file, or weights of another configuration.
        ConfigError: no such device.
    """
    there, bundle, folder = usable_device(device), named_folder(name), locate(name, job)
    saved = read_config(folder)
    with told_of(folder / CONFIG_FILE):
        cls = load_class(saved.generator)
        config = configuration.from_json(cls.Config, saved.config, str(folder / CONFIG_FILE))
        weights = without_quantized(read_tensors(folder / WEIGHTS_FILE)[0])
        expected = sum(tensor.numel() for tensor in weights.values())
        # Twice as many as the file holds, for what is built besides: a wrong file is refused before it fills memory.
        with numbers_at_most(2 * expected + 2**20, f"{folder / CONFIG_FILE} with a network", "restore both files"):
            generator = cls.from_weights(config, saved.sensor, weights, folder / WEIGHTS_FILE)
    generator.to(there)
    if job == "sample" and is_bundle(bundle):
        generator.bundle = Bundle({each: partial(load, bundle, each) for each in ("complete", "raydrop")})
    return generator


def load_class(name: str) -> type[Generator]:
    """Return the generator class of a name, or raise UnknownNameError."""
    return discovery.load_class("generators", name, Generator)

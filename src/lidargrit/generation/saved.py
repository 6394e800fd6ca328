"""A network with its configuration and sensor ⇄ the two files in which it is saved, here or on the Hugging Face hub."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar, Generic, Self, TypeVar, final

import torch
from torch import Tensor, nn

from lidargrit.core import configuration
from lidargrit.core.discovery import load_class, names
from lidargrit.core.errors import ConfigError
from lidargrit.core.files import write_json, write_tensors, write_text
from lidargrit.data.run_folder import CARD_FILE, CONFIG_FILE, WEIGHTS_FILE, Job
from lidargrit.generation.any_sensor import RayNetwork, sharing_weights
from lidargrit.generation.hub import upload
from lidargrit.generation.pixel_decoder.ray_encoding import check_bounds
from lidargrit.nn.exact_weights import load_exactly
from lidargrit.nn.quantization import WeightBits, with_quantized
from lidargrit.nn.size import numbers_at_most
from lidargrit.scans.condition import Observed
from lidargrit.scans.sensors import SensorModel

_NEVER_PUBLISHED = ("usage", "code_sums", "num_batches_tracked", "scale_m")  # buffers that no program's file holds

RunT = TypeVar("RunT")


class Bundle(Generic[RunT]):
    """Runs that complete scans in the place of a generator, each read when it is first needed.

    Args:
        runs: function that reads the run of each job.
    """

    def __init__(self, runs: Mapping[Job, Callable[[], RunT]]) -> None:
        self._runs, self._read = runs, dict[Job, RunT]()

    def shares(self, condition: Observed) -> Iterator[tuple[RunT | None, list[int]]]:
        """Yield each run with the indices of the scans that it completes; None for those that no run completes."""
        jobs: list[Job] = [job_of(condition[[index]]) for index in range(len(condition))]
        for job in dict.fromkeys(jobs):
            yield self._run(job), [index for index, each in enumerate(jobs) if each == job]

    def _run(self, job: Job) -> RunT | None:
        if job in self._runs and job not in self._read:
            self._read[job] = self._runs[job]()
        return self._read.get(job)


def job_of(condition: Observed) -> Job:
    """Return the job that completes a scan: ``raydrop`` where all surfaces are known, ``complete`` where pixels are.

    A scan of which nothing is known, or parts of both kinds, is left to the run that samples.
    """
    if condition.has_all_surfaces:
        return "raydrop"
    has_pixels = bool(condition.return_observed.any()) and "surfaces" not in condition.kinds
    return "complete" if has_pixels else "sample"


ConfigT = TypeVar("ConfigT")


class SavedModel(nn.Module, Generic[ConfigT]):
    """A network that is made from a configuration and a sensor, and that can be written to a folder."""

    Config: ClassVar[type]
    published_files: ClassVar[tuple[str, ...]] = ()
    """Contents of the files in which the system's authors published weights, in order; empty if we read none."""

    def __init__(self, config: ConfigT, sensor: SensorModel) -> None:
        super().__init__()
        self.config, self.sensor = config, sensor

    @classmethod
    def public_name(cls) -> str:
        """Return the name of the folder in which ``system.py`` defines the class."""
        return cls.__module__.removesuffix(".system").rpartition(".")[2]

    @property
    def takes_any_sensor(self) -> bool:
        """Whether all of its networks are told a sensor's rays, so that it learns and completes scans of any."""
        networks = list(self.children())
        return bool(networks) and all(isinstance(each, RayNetwork) and each.any_sensor for each in networks)

    def for_sensor(self, sensor: SensorModel) -> Self:
        """Return the network with the same weights for the scans of another sensor; itself for its own rays.

        Raises:
            ConfigError: a sensor that it does not take, with those that it takes.
        """
        if self.takes_any_sensor:
            check_bounds(sensor)
            with torch.random.fork_rng(devices=[]):  # the weights that it begins with are not used
                return sharing_weights(type(self)(self.config, sensor), self).train(self.training)
        if not self.sensor.same_rays(sensor):
            raise ConfigError(
                f"the sensor {sensor.name!r}, {sensor.height}x{sensor.width}, for {self.public_name()!r}",
                f"its own, {self.sensor.name!r}, {self.sensor.height}x{self.sensor.width}",
                "name a run of that sensor, or train multiscale_any, completion_any or raydrop_any, which take any",
            )
        return self

    def weights(self, bits: WeightBits = 32) -> dict[str, Tensor]:
        """Return the tensors that are saved, by name.

        Args:
            bits: bits of a parameter; a network that reads them computes in 32 bits as before. With 8, matrices and
                kernels are quantized, and vectors such as biases have 16 bits. Buffers are saved as they are.
        """
        named = {} if bits == 32 else {name: each.detach() for name, each in self.named_parameters()}
        halved = {name: each.half() for name, each in named.items()}
        for name, weight in halved.items():
            if not weight.isfinite().all():
                largest = named[name].abs().max()
                raise ConfigError(f"weights {name!r} of up to {largest:g}", "at most 65,504", "store 32 bits")
        matrices = {name: each for name, each in named.items() if bits == 8 and each.ndim >= 2}
        return with_quantized({**self.state_dict(), **halved, **matrices}, matrices.keys())

    def save(self, folder: Path, bits: WeightBits = 32) -> None:
        """Write :meth:`weights` and, last, the configuration that says they are there."""
        write_tensors(folder / WEIGHTS_FILE, self.weights(bits))
        config = {
            "generator": self.public_name(),
            "config": configuration.to_json(self.config),
            "sensor": self.sensor.to_json(),
        }
        write_json(folder / CONFIG_FILE, config)

    @classmethod
    def from_weights(cls, config: Any, sensor: SensorModel, weights: dict[str, Tensor], source: Path) -> Self:
        """Make a generator with given weights."""
        generator = cls(config, sensor)
        load_exactly(generator, weights, source)
        return generator.eval()

    @classmethod
    @final
    def from_published(cls, files: Sequence[Path], config: ConfigT, sensor: SensorModel) -> Self:
        """Make a generator with the weights that the system's authors published, or that their program saved.

        Args:
            files: one file for each of ``published_files``, in that order; code in them is not run.
            config: sizes of the networks, used where the files do not tell them.
            sensor: sensor whose rays are the pixels of the authors' images. Networks that know the rays keep those of
                their training.

        Raises:
            CheckpointError: other files, or weights of other sizes.
        """
        config, networks = cls.read_published(files, config, sensor)
        numbers = sum(path.stat().st_size for path in files) // 2 + 2**20
        with numbers_at_most(numbers, f"{files[0]} with a network", "check which program saved it"):
            generator = cls(config, sensor)
        for number, (name, weights) in enumerate(networks.items()):
            network = generator.get_submodule(name)
            own = network.state_dict()
            kept = {each: own[each] for each in own if each.rpartition(".")[2] in _NEVER_PUBLISHED}
            load_exactly(network, kept | weights, files[number % len(files)])
        return generator.eval()

    @classmethod
    def read_published(
        cls, files: Sequence[Path], config: ConfigT, sensor: SensorModel
    ) -> tuple[ConfigT, dict[str, dict[str, Tensor]]]:
        """Read the configuration and the weights in published files; see :meth:`from_published`.

        Returns:
            the configuration, and the weights of each network by its name here, "" for the whole model; if there are
            several files, one network of each.
        """
        able = [name for name in names("generators") if load_class("generators", name, SavedModel).published_files]
        raise ConfigError(
            f"a generator {cls.public_name()!r}, of which nobody published weights",
            f"a preset of {', '.join(able)}",
            "see which generator a preset has with: lidargrit train PRESET OUT --dry-run",
        )

    def save_pretrained(
        self,
        save_directory: str | Path,
        *,
        card: str = "",
        bits: WeightBits = 8,
        repo_id: str | None = None,
        push_to_hub: bool = False,
        token: str | None = None,
        private: bool | None = None,
    ) -> str | None:
        """Write what a repository of the Hugging Face hub holds: weights, configuration, and a model card if given.

        These are the files of :meth:`save`. ``lidargrit publish`` writes the card from a run.

        Args:
            save_directory: folder that gets the files.
            card: text of ``README.md``, in Markdown; no such file if empty.
            bits: bits of a parameter, 8, 16 or 32; see :meth:`weights`.
            repo_id: repository that gets them, USER/NAME; named by the folder if not given.
            push_to_hub: whether to upload the files, too.
            token: the user's token; the one that the hub's client has saved if not given.
            private: whether a new repository is private; the user's setting on the hub if not given.

        Returns:
            address of the commit if they were uploaded.
        """
        folder = Path(save_directory)
        self.save(folder, bits)
        if card:
            write_text(folder / CARD_FILE, card)
        if not push_to_hub:
            return None
        # Not the folder, in which other files may lie: a run's checkpoints and its scans' names are its owner's.
        return self.push_to_hub(repo_id or folder.name, card=card, bits=bits, private=private, token=token)

    def push_to_hub(
        self,
        repo_id: str,
        *,
        card: str = "",
        bits: WeightBits = 8,
        commit_message: str = "Add a model",
        private: bool | None = None,
        token: str | None = None,
        branch: str | None = None,
        create_pr: bool | None = None,
    ) -> str:
        """Upload what :meth:`save_pretrained` writes, and return the address of the commit.

        Args:
            repo_id: repository, USER/NAME; made if it is missing.
            branch: branch that gets the files; the main branch if not given.
            create_pr: whether to open a pull request in place of a commit.
        """
        with TemporaryDirectory() as folder:
            self.save_pretrained(folder, card=card, bits=bits)
            return upload(
                Path(folder),
                repo_id,
                commit_message=commit_message,
                private=private,
                token=token,
                branch=branch,
                create_pr=create_pr,
            )

"""Preset → finished model in a run folder: the stages are trained in turn, and each resumes where it stopped."""

import copy
import hashlib
import importlib
import platform
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import torch

from lidargrit.core import configuration, reporting
from lidargrit.core.determinism import derive_seed
from lidargrit.core.errors import CheckpointError, ConfigError, OutputError, kind_and_words
from lidargrit.core.files import claim_folder, claimed_manifest, is_taken, read_json, write_json
from lidargrit.core.processes import rank_and_world_size
from lidargrit.core.version import __version__
from lidargrit.data.images import Provenance, RangeImages
from lidargrit.data.run_folder import RUN_FILE, TRAINED_ON_FILE, locate, preset_settings, trained_on, write_trained_on
from lidargrit.data.sources import joined_images
from lidargrit.generation.generator import Generator
from lidargrit.generation.objective import Objective
from lidargrit.generation.settings import Preset
from lidargrit.training.checkpoint import fingerprint
from lidargrit.training.engine import Engine
from lidargrit.training.plan import CheckedStages, OpenedData, check_stages, open_data
from lidargrit.training.stage import StageTraining
from lidargrit.training.taken_stages import taken_facts

_IMAGES = "_images"  # of a hash of images, in place of their names
# Settings of a preset that change nothing that is computed, the last two of each stage.
_NO_CHANGE, _NO_CHANGE_OF_STAGES = {"title", "published", "data.workers"}, ("checkpoint_every", "pictures_every")

PlotProgress = Callable[[Generator, str, RangeImages, Path], None]
"""Plots what a half-trained generator makes at a stage, beside validation scans, into a file."""


def train(preset: Preset, folder: Path, plot: PlotProgress | None = None, wandb_project: str = "") -> Generator:
    """Train every stage of a preset in a run folder and return the finished generator.

    The same call resumes a stopped training. Before the first step, the folder holds ``run.json`` (preset, command,
    versions); each stage adds a folder with its checkpoint and log; at the end ``config.json`` and
    ``model.safetensors`` are written. Under a launcher such as torchrun, every process makes this call, and only the
    first one writes. No second training can run in the folder at the same time.

    Args:
        preset: experiment to train.
        folder: run folder.
        plot: function that plots the progress, called every ``pictures_every`` scans of a stage.
        wandb_project: project of Weights & Biases that is told of the run, too; "" for none.

    Raises:
        OutputError: the folder holds something else, another process trains in it, or it cannot be written.
        DataError, ScanError: the data cannot be used.
        TrainingError: the loss is not finite, or another process of a launcher has died.
        ConfigError: a stage to be taken from another run has other settings or another sensor than the preset.
    """
    engine = Engine("fp32")  # tells which of several processes is the first, the only one that writes
    with ExitStack() as held, engine.lost_processes_reported():
        if engine.rank:
            held.enter_context(reporting.to(reporting.Reporter()))
        engine.by_first(lambda: check_folder(folder, preset))
        checked = check_stages(preset, engine.world_size)
        opened = open_data(preset)
        engine.by_first(lambda: held.enter_context(claim_folder(folder)))
        engine.by_first(lambda: check_folder(folder, preset))  # another process may have trained in it meanwhile
        begun = claimed_manifest(folder / RUN_FILE, folder / TRAINED_ON_FILE)
        engine.by_first(lambda: held.enter_context(begun))
        engine.by_first(lambda: held.enter_context(tracked(wandb_project, preset, folder)))
        return _train(preset, checked, opened, folder, plot, engine)


def _train(
    preset: Preset, checked: CheckedStages, opened: OpenedData, folder: Path, plot: PlotProgress | None, engine: Engine
) -> Generator:
    train_images = joined_images(opened.train, preset.data)
    val_images = joined_images(opened.val, preset.data)
    if shared := train_images.provenance.overlap(val_images.provenance):
        reporting.message(f"WARNING: train and val overlap ({shared}): scores on val flatter the model")
    checked.check_images("data.train", train_images)
    checked.check_images("data.val", val_images)
    with torch.random.fork_rng(range(torch.cuda.device_count())):  # the caller's own random numbers stay as they are
        torch.manual_seed(derive_seed(preset.seed, 9))
        generator = preset.build_generator()
        engine.by_first(lambda: _claim(folder, preset, train_images, val_images))
        generator.fit_statistics(train_images)

        def training_of(number: int, stage: str, built_on: str) -> StageTraining:
            seed, objective = derive_seed(preset.seed, number), generator.objective(stage)
            if stage in checked.taken:
                taken = objective.weights_from(checked.taken[stage])
                objective.load_state_dict({**objective.state_dict(), **taken})
            picture = None if plot is None else partial(_plot, plot, generator, stage, val_images)
            workers, config = preset.data.workers, preset.settings_of(stage)
            of_stage = (objective, config, folder / stage, seed, built_on, workers, checked.told, picture)
            return StageTraining(*of_stage).begun()

        built_on = ""
        for number, stage in enumerate(generator.stages):
            if stage in checked.frozen:
                trained = checked.taken[stage]
            else:
                trained = training_of(number, stage, built_on).run(train_images, val_images, f"training {stage}")
            generator.load_stage(stage, trained)
            built_on = fingerprint(trained)
            del trained  # with the tokens that it has kept of the scans
        generator.after_training()
    engine.by_first(lambda: generator.save(folder))
    return generator.cpu().eval()


def _plot(
    plot: PlotProgress, generator: Generator, stage: str, val_images: RangeImages, averaged: Objective, path: Path
) -> None:
    """Plot a copy that has the averaged weights: those of the generator itself are being trained."""
    copied = copy.deepcopy(generator)
    copied.load_stage(stage, averaged)
    plot(copied.to(next(averaged.parameters()).device).eval(), stage, val_images, path)


def check_folder(folder: Path, preset: Preset) -> None:
    """Refuse a folder that holds something else than a run of this preset."""
    if (folder / RUN_FILE).exists():
        about, mine = read_json(folder / RUN_FILE), configuration.leaves(configuration.to_json(preset))
        if not (other := preset_settings(about)):
            raise CheckpointError(f"{folder / RUN_FILE} without a preset", "what lidargrit wrote", "restore the file")
        if "origin" in about:
            raise OutputError(
                f"{folder}, whose weights were {about['origin']}", "a run of train's", "choose another folder"
            )
        settings = {name for name in mine.keys() | other.keys() if not name.endswith(_NO_CHANGE_OF_STAGES)} - _NO_CHANGE
        differing = [name for name in settings if (mine.get(name) or None) != (other.get(name) or None)]
        if differing:
            name = sorted(differing)[0]
            raise OutputError(
                f"{folder}, which holds another run (there {name}={other.get(name)}, here {mine.get(name)})",
                "an empty folder, or the folder of this very preset",
                "choose another folder, or use the settings that the run began with",
            )
    elif is_taken(folder):
        raise OutputError(
            f"{folder}, which is not empty and holds no run",
            "an empty folder, or one that this preset began",
            "choose another folder",
        )


def _claim(folder: Path, preset: Preset, train_images: RangeImages, val_images: RangeImages) -> None:
    """Write ``run.json``, or check that a resumed run has the data with which it began."""
    data = {
        "sensor": train_images.sensor.to_json(),
        **{
            f"{part}{what}": hashlib.sha256("\n".join(values).encode()).hexdigest()
            for part, images in (("train", train_images), ("val", val_images))
            for what, values in (("", images.provenance.names), (_IMAGES, images.provenance.fingerprints))
        },
    }
    if (folder / RUN_FILE).exists():
        before = read_json(folder / RUN_FILE).get("data")
        if not isinstance(before, dict):
            raise CheckpointError(
                f"{folder / RUN_FILE}, whose 'data' hold no names", "what lidargrit wrote", "restore it"
            )
        for name, value in data.items():
            if before.get(name) != value:
                part = name.removesuffix(_IMAGES)
                raise OutputError(
                    f"{folder}, whose run began with {'another sensor' if name == 'sensor' else f'other {part} scans'}",
                    "what it began with",
                    "restore it, or choose another folder",
                )
        _write_trained_on(folder, train_images, preset.start_runs.values())
        return
    about: dict[str, Any] = {
        "preset": configuration.to_json(preset),
        "data": data,
        "streets": list(train_images.provenance.streets),
        **({"taken": taken_facts(preset)} if preset.start_runs else {}),
        "command": sys.argv,
        "lidargrit": __version__,
        "commit": _commit(),
        "torch": torch.__version__,
        "python": platform.python_version(),
    }
    write_json(folder / RUN_FILE, about)
    _write_trained_on(folder, train_images, preset.start_runs.values())


def _write_trained_on(folder: Path, train_images: RangeImages, runs: Iterable[str]) -> None:
    """Write what the model learns from: the training scans, and those of the stages that it takes."""
    if (folder / TRAINED_ON_FILE).exists():
        return
    learned = [train_images.provenance, *(trained_on(locate(run)) for run in sorted({*runs}))]
    write_trained_on(folder, Provenance.joined(learned))


def _commit() -> str:
    """Return the commit of this program; "unknown" where it lies in another repository, as in a virtual environment."""
    file = Path(__file__)
    try:
        command = ["git", "-C", str(file.parent), "rev-parse", "HEAD", f"HEAD:./{file.name}"]
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=5)
        return done.stdout.partition("\n")[0]
    except (OSError, subprocess.SubprocessError):
        return "unknown"


@contextmanager
def tracked(project: str, preset: Preset, folder: Path) -> Iterator[None]:
    """Send what is logged within the ``with`` block to a project on Weights & Biases; a resumed run is one run there.

    Args:
        project: name of the project; "" to send nothing.
    """
    if not project or rank_and_world_size(None, None)[0] > 0:  # of several processes the first one logs
        yield
        return
    wanted, cure = "the package wandb", "pip install 'lidargrit[wandb]', or leave --wandb out"
    try:
        wandb = importlib.import_module("wandb")  # an extra: nothing else needs it
        folder.parent.mkdir(parents=True, exist_ok=True)
        run = wandb.init(
            project=project,
            name=folder.name,
            id=hashlib.sha256(str(folder.resolve()).encode()).hexdigest()[:16],
            resume="allow",
            config=configuration.to_json(preset),
            dir=folder.parent,
            sync_tensorboard=True,
        )
    except ImportError:
        raise ConfigError(f"--wandb {project}, and no wandb", wanted, cure) from None
    except Exception as error:  # its client has many kinds, from a missing key to a broken line, and changes them
        got = f"--wandb {project}, where {kind_and_words(error)}"
        cure = "log in with: wandb login, or set WANDB_MODE=offline"
        raise ConfigError(got, "a project that can be written to", cure) from None
    failed = 1
    try:
        yield
        failed = 0
    finally:
        run.finish(exit_code=failed)

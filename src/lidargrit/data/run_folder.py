"""The folder of a finished run, or of a bundle of runs: its name → its files, and what they say of its training."""

import json
import string
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

from lidargrit.core import configuration
from lidargrit.core.errors import CheckpointError, ConfigError, LidarGritError, UnknownNameError, nearest_names, one_of
from lidargrit.core.files import is_taken, read_json, sha256_of, write_text
from lidargrit.data.images import Provenance
from lidargrit.scans.projection import ProjectionVariant, variant_named
from lidargrit.scans.sensors import SensorModel

CONFIG_FILE, WEIGHTS_FILE, CARD_FILE = "config.json", "model.safetensors", "README.md"  # the names that the hub knows
RUN_FILE = "run.json"  # ``origin`` in it says that the weights beside it were not trained in this folder
CHECKPOINT_FILE = "checkpoint.safetensors"  # of a stage, in its own folder
BUNDLE_FILE = "bundle.json"  # names the folders of runs beside it by the job that each does
TRAINED_ON_FILE = "trained_on.json"  # in the folder of a run or of its bundle, and beside its samples
_NAMES_AT_MOST = 10_000_000  # that a file stands for by their first and last
PRETRAINED = Path(__file__).parents[1] / "pretrained"
PACKAGED = (PRETRAINED, PRETRAINED.with_name("pretrained_wide"))  # their names go wherever a run is wanted


Job = Literal["sample", "complete", "raydrop", "segment", "drive"]
"""What a run of a bundle does: sample new scans, complete scans, drop returns, label scans, or go on with drives."""


def named_folder(name: str | Path) -> Path:
    """Return the folder of a run or of a bundle.

    Args:
        name: path of the folder; ``pretrained`` and ``pretrained_wide`` are in the package, unless you have your own,
            and ``pretrained/completion`` is a run of the first.
    """
    path, packaged = Path(name), {folder.name: folder for folder in PACKAGED}
    first, *run = path.parts or ("",)
    is_packaged = first in packaged and len(run) <= 1 and not is_taken(Path(first))
    return packaged[first].joinpath(*run) if is_packaged else path


def locate(name: str | Path, job: Job = "sample") -> Path:
    """Return the folder of a run; of a bundle, that of its run for a job, and of the one that samples if none."""
    folder = named_folder(name)
    if not is_bundle(folder):
        return folder
    runs = _runs_of(folder)
    return folder / runs.get(job, runs["sample"])


def is_bundle(folder: Path) -> bool:
    """Return whether a folder is that of a bundle of runs."""
    return (folder / BUNDLE_FILE).is_file()


def _runs_of(bundle: Path) -> dict[str, str]:
    runs, names = read_json(bundle / BUNDLE_FILE), {path.name for path in bundle.iterdir()}
    if not isinstance(runs, dict) or "sample" not in runs or not {*runs} <= {*get_args(Job)}:
        got, wanted = f"{bundle / BUNDLE_FILE} without a run that samples, or with an unknown job", str(get_args(Job))
        raise CheckpointError(got, f"folders by their jobs, {wanted}", "restore the file")
    for run in runs.values():
        if not isinstance(run, str) or run not in names:
            got = f"{bundle / BUNDLE_FILE}, which names {str(run)[:40]!r}"
            raise CheckpointError(got, "folders that lie beside it", "restore the folder")
    return runs


def is_run(folder: Path) -> bool:
    """Return whether a folder is that of a finished run."""
    return (folder / CONFIG_FILE).is_file()


def is_unfinished(folder: Path) -> bool:
    """Return whether a folder is that of a run whose training has not ended, or of one of its stages."""
    return not is_run(folder) and any((folder / name).is_file() for name in (RUN_FILE, CHECKPOINT_FILE))


class SavedConfig(NamedTuple):
    """What the configuration of a finished run says."""

    generator: str
    config: Any
    sensor: SensorModel


def read_config(folder: Path) -> SavedConfig:
    """Read the configuration of a finished run."""
    if not is_run(folder):
        packaged = [each.name for each in PACKAGED]
        if not folder.exists():
            wanted = f"a run's folder, or {nearest_names(folder.name, packaged)}"
            raise CheckpointError(f"{folder}, which does not exist", wanted, "check the path")
        raise CheckpointError(
            f"{folder}, which holds no finished model",
            f"a run's folder with {CONFIG_FILE} and {WEIGHTS_FILE}, or {one_of(packaged)}",
            "finish the training (lidargrit train with the same words goes on), or check the path",
        )
    path = folder / CONFIG_FILE
    about = read_json(path)
    with told_of(path), shaped_as_ours(path):
        config, sensor, generator = about["config"], SensorModel.from_json(about["sensor"]), about["generator"]
        return SavedConfig(str(generator), config, sensor)


def takes_any_sensor(folder: Path) -> bool:
    """Return whether the networks of a finished run are told of a sensor's rays; its own is then but one of many."""
    settings = configuration.leaves(read_config(folder).config) if is_run(folder) else {}
    return any(name.endswith(".any_sensor") and value is True for name, value in settings.items())


@contextmanager
def told_of(path: Path) -> Iterator[None]:
    """Turn what the ``with`` block meets in a file of settings into a CheckpointError that names the file."""
    try:
        yield
    except (ConfigError, UnknownNameError) as error:
        names_it = str(path) in error.got
        got = error.got if names_it else f"{path}, in which stands {error.got}"
        raise CheckpointError(got, error.wanted, error.cure if names_it else "restore the file") from None


@contextmanager
def shaped_as_ours(path: Path) -> Iterator[None]:
    """Turn what the ``with`` block meets in JSON of another shape than ours into a CheckpointError with its file."""
    try:
        yield
    except LidarGritError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        got = f"{path}, which cannot be used ({error!r})"
        raise CheckpointError(got, "what lidargrit wrote", "restore the file") from None


def weights_sha256(folder: Path) -> str:
    """Return the hash of the weights of a run, by which they are told from others."""
    return sha256_of(folder / WEIGHTS_FILE)


def preset_settings(about: Any) -> dict[str, Any]:
    """Return every setting of the preset in a ``run.json`` by its name of today; none where there is no preset."""
    return configuration.leaves(about.get("preset") if isinstance(about, dict) else {})


def taken_over(about: Any) -> dict[str, Any]:
    """Return what a ``run.json`` says of weights that came from other runs: ``train``, ``files`` and ``training``.

    Those are the sources of their training scans, the files of imported weights, and the settings of stages that were
    not trained in the run.
    """
    return {"train": [], "files": [], "training": {}, **about.get("taken", {})}


def recorded_projection(folder: Path) -> str:
    """Return by which variant of the projection the training scans of a run became images; "" if it is not known."""
    path = folder / RUN_FILE
    variant = preset_settings(read_json(path) if path.is_file() else {}).get("data.projection_variant")
    return variant if isinstance(variant, str) else ""


def projection_variant(folder: Path) -> ProjectionVariant:
    """Return the variant by which scans become images for the model of a run; "exact" if it is not known."""
    return variant_named(recorded_projection(folder))


def trained_on(folder: Path) -> Provenance:
    """Return what the model of a run, or of a folder of samples, learned from; empty where that is not known."""
    path = trained_on_file(folder)
    if path is None:
        return Provenance()
    try:
        facts = {name: tuple(of) for name, of in read_json(path).items()}
        facts["recordings"] = tuple(_each_name(facts["recordings"]))
        if not all(isinstance(each, str) for of in facts.values() for each in of):
            raise TypeError("something is no text")
        return Provenance(**facts)
    except (TypeError, KeyError, ValueError, AttributeError) as error:
        raise CheckpointError(f"{path}, in which {error}", "what lidargrit wrote", "restore it, or remove it") from None


def trained_on_file(folder: Path) -> Path | None:
    """Return the file that says what a run learned from, which the runs of a bundle may share; None without one."""
    own, shared = folder / TRAINED_ON_FILE, folder.parent / TRAINED_ON_FILE
    if own.is_file():
        return own
    return shared if is_bundle(folder.parent) and shared.is_file() else None


def write_trained_on(folder: Path, provenance: Provenance) -> None:
    """Write what a model learned from, without names of the user's files, so that its samples can tell it, too.

    Names of recordings that differ in a number alone, as those of simulated streets do, are written as the first and
    the last of them.
    """
    listed = {
        "recordings": _first_and_last({*provenance.recordings} - {""}),
        "fingerprints": sorted({*provenance.fingerprints}),
        "range_fingerprints": sorted({*provenance.range_fingerprints}),
    }
    write_text(folder / TRAINED_ON_FILE, json.dumps(listed, separators=(",", ":")) + "\n")


def _first_and_last(names: Iterable[str]) -> list[str | dict[str, str]]:
    """Return sorted names, with the first and the last in place of three or more that are numbered consecutively."""
    groups: list[list[str]] = []
    for name in sorted(names):
        if groups and name == _next_name(groups[-1][-1]):
            groups[-1].append(name)
        else:
            groups.append([name])
    written: list[str | dict[str, str]] = []
    for group in groups:
        written += [{"first": group[0], "last": group[-1]}] if len(group) > 2 else group
    return written


def _next_name(name: str) -> str | None:
    """Return the name that ends in the next number, of as many digits; None if there is none."""
    stem, digits = _split(name)
    following = f"{int(digits) + 1:0{len(digits)}d}" if digits else ""
    return stem + following if digits and len(following) == len(digits) else None


def _each_name(written: Iterable[object]) -> Iterator[object]:
    """Yield the names that :func:`_first_and_last` wrote."""
    left = _NAMES_AT_MOST
    for each in written:
        if not isinstance(each, dict):
            yield each
            continue
        (stem, first), (other_stem, last) = _split(each["first"]), _split(each["last"])
        left -= int(last or 0) - int(first or 0)
        if stem != other_stem or len(first) != len(last) or not first < last or left < 0:
            raise ValueError(f"{each['first']} to {each['last']} are no numbered names, or more than {_NAMES_AT_MOST}")
        yield from (f"{stem}{number:0{len(first)}d}" for number in range(int(first), int(last) + 1))


def _split(name: str) -> tuple[str, str]:
    stem = name.rstrip(string.digits)
    return stem, name[len(stem) :]

"""Import and publication of weights: files of a system's authors → a run folder; a run → a folder for others."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from lidargrit.core import configuration
from lidargrit.core.errors import ConfigError, OutputError
from lidargrit.core.files import claim_folder, is_taken, read_json, sha256_of, write_json
from lidargrit.core.version import __version__
from lidargrit.data.run_folder import (
    CARD_FILE,
    RUN_FILE,
    locate,
    shaped_as_ours,
    taken_over,
    trained_on,
    weights_sha256,
    write_trained_on,
)
from lidargrit.data.sources import data_set_of
from lidargrit.evaluation.scorecard import Scorecard
from lidargrit.generation.generator import Generator, load, load_class
from lidargrit.generation.presets import load_preset
from lidargrit.nn.quantization import WeightBits, without_quantized
from lidargrit.publishing.card import model_card


def import_weights(preset: str, folder: Path, files: Sequence[Path], settings: Sequence[str] = ()) -> Generator:
    """Make a run folder from weights that a system's authors published, or that their program saved.

    Args:
        preset: name of the preset, which names the generator, its sizes and the sensor; nothing is trained.
        folder: folder that gets ``run.json``, ``model.safetensors`` and ``config.json``, as after training.
        files: files of ``torch.save``, in the order of the generator's ``published_files``; code in them is not run.
        settings: changed settings of the preset, such as ``data.projection_variant=reference``.
    """
    if not (folder / RUN_FILE).is_file():
        _refuse_taken(folder, None)  # before much is read
    made_of = load_preset(preset, settings)
    cls = load_class(made_of.generator)
    if cls.published_files and len(files) != len(cls.published_files):
        raise ConfigError(
            f"{len(files)} {'file' if len(files) == 1 else 'files'}",
            f"{len(cls.published_files)}, for the {' and the '.join(cls.published_files)} of {made_of.generator!r}",
            "name them in this order",
        )
    generator = cls.from_published(files, made_of.model, made_of.data.load_sensor())
    about: dict[str, Any] = {
        "origin": "imported",
        "files": [{"name": path.name, "sha256": sha256_of(path)} for path in files],
        "preset": configuration.to_json(made_of),
        "lidargrit": __version__,
    }
    with claim_folder(folder):
        _refuse_taken(folder, about)
        write_json(folder / RUN_FILE, about)
        generator.save(folder)
    return generator


def publish(
    run: Path, folder: Path, scores: Path | None = None, notes: str = "", bits: WeightBits | None = None
) -> str:
    """Write the files of a run that others need into a folder, without the user's own paths; nothing is uploaded.

    A command that was killed, or that met a full disk, goes on where the same run is published again.

    Args:
        run: folder of a finished run.
        folder: folder that gets ``model.safetensors``, ``config.json``, the run's preset and training recordings
            without paths and file names, and last a model card (``README.md``). It can be used wherever a run can.
        scores: scores of the run's samples, as ``lidargrit evaluate --json`` wrote them.
        notes: Markdown for the end of the card: what the model is good for, and where it fails.
        bits: bits of a stored parameter, 8, 16 or 32. If not given, 8; beside scores 32, as they are of whole weights.

    Returns:
        Text of the card.
    """
    run, bits = locate(run), bits or (32 if scores else 8)
    generator = load(run)
    if (folder / CARD_FILE).exists() or not folder.is_dir():
        _refuse_taken(folder, None)  # soon, before much is read
    about: Any = read_json(run / RUN_FILE) if (run / RUN_FILE).is_file() else {}
    card_scores = Scorecard.read(scores) if scores else None
    whole, written = generator.state_dict(), without_quantized(generator.weights(bits))
    if card_scores:
        _check_scores(card_scores, run)
        if any(not torch.equal(weight, written[name].to(weight.dtype)) for name, weight in whole.items()):
            raise ConfigError(
                "scores of weights that are then rounded",
                "those of the rounded ones",
                f"publish with --bits {bits} alone, score that, and publish it with its scores",
            )
    learned = trained_on(run)
    with shaped_as_ours(run / RUN_FILE):
        card, public = model_card(generator, about, learned, card_scores, bits), _public_facts(about, generator)
    card = "\n".join(filter(None, [card, notes.strip() and notes.strip() + "\n"]))
    with claim_folder(folder):
        _refuse_taken(folder, public)
        write_json(folder / RUN_FILE, public)
        if learned.recordings or learned.fingerprints:
            # A recording that has no name of its own is named by its folder, which is the user's; by its path, in runs
            # of an earlier version.
            named = (each for each in learned.recordings if not each.startswith("#"))
            drives = tuple(recording for recording in named if not Path(recording).is_absolute())
            write_trained_on(folder, replace(learned, recordings=drives))
        generator.save_pretrained(folder, card=card, bits=bits)  # the card last: it says that the folder is finished
    return card


def _refuse_taken(folder: Path, begun: dict[str, Any] | None) -> None:
    """Raise OutputError unless a folder is empty, or holds these facts of a run and no card yet."""
    if not is_taken(folder):
        return
    unfinished = folder.is_dir() and not (folder / CARD_FILE).exists() and (folder / RUN_FILE).is_file()
    if begun is None or not unfinished or read_json(folder / RUN_FILE) != json.loads(json.dumps(begun)):
        raise OutputError(f"{folder}, which is not empty", "an empty folder", "choose another one")


def _public_facts(about: dict[str, Any], generator: Generator) -> dict[str, Any]:
    """Return the facts of ``run.json`` without the command, and with data sets and splits in place of sources."""
    preset = about.get("preset", {})
    data = preset.get("data", {})
    sources = {part: ["::".join(data_set_of(source)) for source in data.get(part, ())] for part in ("train", "val")}
    preset = {
        **preset,
        "training": _without_starts(preset.get("training", {})),
        "data": {**data, **sources, "sensor": generator.sensor.name},
    }
    kept = {name: about[name] for name in ("files", "lidargrit", "commit", "torch", "python") if name in about}
    if (taken := taken_over(about))["train"]:
        train = ["::".join(data_set_of(source)) for source in taken["train"]]
        kept["taken"] = {**taken, "train": train, "training": _without_starts(taken["training"])}
    return {"origin": "published", **kept, "preset": preset}


def _without_starts(training: dict[str, Any]) -> dict[str, Any]:
    """Return settings of stages without the runs that they started from, which are folders of the user."""
    return {stage: config and {**config, "start": ""} for stage, config in training.items()}


def _check_scores(scores: Scorecard, run: Path) -> None:
    """Raise ConfigError if the scores are not of samples of these weights."""
    if scores.samples.weights_sha256 != weights_sha256(run):
        got = f"scores of {scores.samples.source}, which were not sampled from {run}"
        raise ConfigError(got, "scores of this run's samples", "evaluate those")

"""What the verbs complete, upsample and raydrop have in common: their options, and what they say in the end."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from lidargrit.cli._options import add_count, add_device, add_scans, sampling_words, scan_settings
from lidargrit.cli._results import look_at
from lidargrit.core.errors import counted_scans
from lidargrit.core.untrusted import WholeNumber, seed_number

if TYPE_CHECKING:
    from lidargrit.data.run_folder import Job
    from lidargrit.inference.complete import Model
    from lidargrit.inference.complete.files import Written
    from lidargrit.inference.complete.tasks import Task
    from lidargrit.scans.sensors import SensorModel


def add_completion(parser: argparse.ArgumentParser, model: str, points_only: bool = False) -> None:
    """Add the options of all three verbs: source, folder, ``model``, number and kind of files."""
    parser.set_defaults(goes_on=True, ray="")
    images = ", samples, prepared scans, or range images as .npy"
    scans = f"scans: a file, a folder, NAME:ROOT:SPLIT{' of points' if points_only else images}"
    parser.add_argument("scans", help=scans)
    parser.add_argument("out", type=Path, help="folder for the files: empty, or begun by the same command")
    parser.add_argument("--model", default="pretrained", help=model)
    add_count(parser)
    each = "number of random results for each scan; several lie in OUT/completion_0, OUT/completion_1, ..."
    parser.add_argument("--samples", type=WholeNumber(1), default=1, help=each)
    parser.add_argument("--seed", type=seed_number, default=0, help="seed of the first result")
    kind = "format of the clouds, a name from: lidargrit list formats (default: that of each scan's file); or image "
    parser.add_argument("--format", default="", help=kind + "for the model's range images alone, as .npy")
    add_scans(parser, "settings of sampling, as sampling.temperature=0.9, and of reading scans, as data.columns=1024")
    add_device(parser)


def open_model_for(options: argparse.Namespace, task: "Task", sensor: "SensorModel | None") -> "Model":
    """Return the model that the options name.

    Args:
        options: parsed options of one of the three verbs.
        task: the work on each scan.
        sensor: sensor that is named for a classical method, which gives whole clouds all of its columns; a run has its
            own, and refuses another.
    """
    from lidargrit.inference.complete import is_classical, open_model

    if sensor is not None and is_classical(options.model) and options.format != "image":
        sensor = sensor.fine()
    model = open_model(options.model, task.kind, sensor, sampling_words(options.set), options.device)
    return replace(model, projection=scan_settings(options).data.projection)


def named_sensor(options: argparse.Namespace, is_needed: bool, job: "Job" = "complete") -> "SensorModel | None":
    """Return the sensor that the user named, else that of the source, which is told if guessed.

    Args:
        is_needed: whether the model has no sensor of its own; a run has, which does ``job``, and refuses another unless
            it takes any.
    """
    from lidargrit.data.sources import open_source
    from lidargrit.data.sources.scan_sensor import sensor_for, sensor_for_run

    settings = scan_settings(options)
    if not is_needed:
        return sensor_for_run(settings, options.scans, options.model, job)
    source = open_source(options.scans, settings.data.bad_points)
    return settings.data.with_projection(sensor_for(source, settings.sensor))


def run_task(options: argparse.Namespace, model: "Model", task: "Task", probability: int = 0) -> None:
    """Do a task with every scan, and say how many points came in and went out, and how to look at them."""
    from lidargrit.inference.complete.files import OutputConfig, complete_scans

    output = OutputConfig(options.samples, options.seed, options.format, probability)
    config = scan_settings(options, max_scans=options.count).data
    where = {"ray": options.ray, "device": options.device}
    found = complete_scans(options.scans, options.out, model, task, output, config, **where)
    print(f"done: {counted_scans(found.scans)} in {options.out}{_points(found, task)}")
    print(look_at(options.out))


def _points(found: "Written", task: "Task") -> str:
    if not found.points_in:
        return "; completed.json says how they were made"
    made = f"{found.points_out:,} points of {found.points_in:,}"
    if not task.adds:
        return f": {made}, {found.points_in - found.points_out:,} dropped"
    kept = found.points_out - found.points_filled
    left = f", {found.points_in - kept:,} that --observed hides left out" if kept < found.points_in else ""
    return f": {found.points_out:,} points, {kept:,} measured and {found.points_filled:,} filled{left}"

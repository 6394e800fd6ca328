"""Requests → range images on disk, in a process of its own that can be killed at any moment.

The process reads and answers lines of JSON: no pickle passes, and the process that talks to clients never computes.
A job that takes too long, or all memory, ends with this process; the next job starts a new one.
"""

import dataclasses
import json
import math
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from lidargrit.core.errors import (
    ConfigError,
    LidarGritError,
    OutputError,
    ScanError,
    UsageError,
    kind_and_words,
    one_of,
)
from lidargrit.core.files import atomic_path, write_text
from lidargrit.data import formats
from lidargrit.data.run_folder import locate, projection_variant
from lidargrit.generation.generator import Generator, load
from lidargrit.inference.complete.inputs import InputScan, ScanReader
from lidargrit.inference.complete.patterns import Pattern
from lidargrit.inference.complete.sparse import SparseReader, observed_rows
from lidargrit.inference.segment import can_label, label_images, open_segmenter
from lidargrit.nn.devices import usable_device
from lidargrit.scans.condition import Observed
from lidargrit.scans.projection import ProjectionVariant
from lidargrit.scans.projection.sensor_check import has_few_rings, ring_count
from lidargrit.scans.sensors import SensorModel, load_sensor
from lidargrit.scans.types import RangeImage, Scan
from lidargrit.simulator import simulate
from lidargrit.simulator.power import RaydropModel
from lidargrit.simulator.setups import setup_of
from lidargrit.systems.segmenter.system import Segmenter
from lidargrit.viewer.interactive import page_data
from lidargrit.viewer.scan_sets import ScanSet
from lidargrit.viewer.serve.requests import EXAMPLES, TASKS, UPSAMPLED, Example, SampleRequest, sampling_settings

PAGE_FILE, PIXELS_FILE = "page.json", "pixels.npz"  # of a result: for the page, and for files to save
_NOT_ON_THE_PAGE = ("lidargrit ", "--", "data.", "sensor")  # words of cures that the page does not offer
_EXAMPLE_SEED = 2_000_003  # a test street: no packaged model learned from it
_NO_POWER = 1e-12  # all but nothing: every beam that meets something is detected
NO_ROOM = OutputError(
    "no room on the server's disk for this scan", "some free space in its temporary folder", "try again later"
)


def run_worker(runs: Sequence[Path], device: str) -> None:
    """Describe the models of the runs, then answer requests from standard input until it ends."""
    answers = sys.stdout
    sys.stdout = sys.stderr  # whatever a library prints is no answer
    try:
        chosen = usable_device(device)
        loaded = [_load(run, chosen) for run in runs]
    except LidarGritError as error:
        _send(answers, {"refused": [type(error).__name__, error.got, error.wanted, error.cure]})
        return
    except RuntimeError as error:  # most of all where a GPU has no room for them
        got = f"models that cannot be loaded on the device ({kind_and_words(error)})"
        cure = "name fewer models, or another --device"
        _send(answers, {"refused": ["ConfigError", got, "a device with room for all of them", cure]})
        return
    names = [run.resolve().name for run in runs]
    names = [name if names.count(name) == 1 else str(run) for name, run in zip(names, runs, strict=True)]
    models = [describe_model(name, one.generator, one.segmenter) for name, one in zip(names, loaded, strict=True)]
    _send(answers, {"models": models})
    for line in sys.stdin:
        message = json.loads(line)
        request = SampleRequest(**message["request"])
        _send(answers, _answer_request(loaded[request.model], request, Path(message["folder"])))


class _Served(NamedTuple):
    """What is read of a run: its generator, the projection of its scans, and the segmenter beside it, if any."""

    generator: Generator
    variant: ProjectionVariant
    segmenter: Segmenter | None


def _load(run: Path, device: torch.device) -> _Served:
    try:
        generator, segmenter = load(run).to(device), None
        if locate(run, "segment") != locate(run):
            segmenter = open_segmenter(str(run), str(device))
            segmenter = segmenter if can_label(segmenter.sensor, generator.sensor) else None
        return _Served(generator, projection_variant(locate(run)), segmenter)
    except LidarGritError as error:
        if str(run) in error.got:
            raise
        raise type(error)(f"{run}: {error.got}", error.wanted, error.cure) from None


def describe_model(name: str, generator: Generator, segmenter: Segmenter | None = None) -> dict[str, Any]:
    """Return the facts of a model that the page needs."""
    sensor = generator.sensor
    tasks = [task for task in TASKS if _can(generator, task)] + ["label"] * (segmenter is not None)
    return {
        "name": name,
        "generator": generator.public_name(),
        "sensor": f"{sensor.name}, {sensor.height} x {sensor.width}",
        "upload": next((able for able in ("complete", "encode") if able in generator.capabilities), ""),
        "tasks": tasks,
        "settings": _settings_of(generator),
        "rays": sensor.to_json(),
    }


def _can(generator: Generator, task: str) -> bool:
    """Return whether a model can do a task: one of upsampling wants rows between those of the other sensor."""
    if "complete" not in generator.capabilities or task == "label":
        return False
    if task in UPSAMPLED:
        try:
            SparseReader(generator.sensor, source=load_sensor(task))
        except ConfigError:
            return False
    return task != "raydrop" or "surfaces" in generator.conditions


def _settings_of(generator: Generator) -> list[dict[str, Any]]:
    """Return the sampling settings, which say where a completion that is told nothing else takes another value.

    Those that generating does not read say so: the page has one field for both.
    """
    settings = []
    for one in sampling_settings(generator.Sampling()):
        value = getattr(generator.completion_sampling(), one.name)
        note = "" if value == one.default else f" If you leave it alone, a scan is completed with {value}."
        note += " Only completing a scan reads it." if one.name in generator.not_of_sampling else ""
        settings.append(dataclasses.asdict(one) | {"about": one.about + note})
    return settings


def compute_result(
    generator: Generator,
    request: SampleRequest,
    variant: ProjectionVariant = "exact",
    segmenter: Segmenter | None = None,
) -> list[ScanSet]:
    """Sample new scans, or complete, upsample, drop, label or reconstruct a scan that is uploaded or an example."""
    # Settings that the client left alone stay with the generator: it may complete by other values than it samples by.
    own = generator.completion_sampling() if request.has_scan else generator.Sampling()
    sampling = dataclasses.replace(own, **request.sampling) if request.sampling else None
    seeds = range(request.seed, request.seed + request.count)
    if not request.has_scan:
        names = tuple(f"seed {seed}" for seed in seeds)
        new = generator.sample(seeds, sampling=sampling).to("cpu")
        return [ScanSet("generated", new, names, generated=True)]
    seen = _read_scan(request, generator, _reader(request, generator, variant))
    image = RangeImage.stack([seen.image])
    if request.task == "label" and segmenter is not None:
        return [ScanSet("labelled", label_images(segmenter, image), (request.name,))]
    given = ScanSet("example" if request.example else "as uploaded", image, (request.name,))
    if "complete" not in generator.capabilities:
        new = generator.reconstruct(image).to("cpu")
        return [given, ScanSet("reconstructed", new, (request.name,), generated=True)]
    measured = torch.zeros_like(image.return_mask)  # nothing in it was filled
    sets = [dataclasses.replace(given, filled=measured)]
    if request.task == "region" and not request.region:
        return sets  # on which the region is drawn
    names = tuple(f"{request.name}, seed {seed}" for seed in seeds)
    images = RangeImage.stack([image[0]] * request.count)
    if request.task == "raydrop":
        dropped = generator.complete(Observed.of_surfaces(images), seeds, sampling)
        nothing = torch.zeros_like(dropped.return_mask, device="cpu")
        return [*sets, ScanSet("with raydrop", dropped.to("cpu"), names, filled=nothing)]
    observed = _observed(request, seen)
    condition = Observed.of_pixels(images, observed.expand_as(images.return_mask))
    if bool((images[0].return_mask & ~observed).any()):
        sets.append(ScanSet("what the model saw", condition[0:1].images, (request.name,), filled=measured))
    completed = generator.complete(condition, seeds, sampling).to("cpu")
    return [*sets, ScanSet("completed", completed, names, filled=completed.return_mask & ~observed)]


def _reader(request: SampleRequest, generator: Generator, variant: ProjectionVariant) -> ScanReader:
    """Return what projects an uploaded scan, which may be a part of the circle where lost returns are completed."""
    completes = "complete" in generator.capabilities  # a model that does not has no task
    if completes and request.task in UPSAMPLED:
        return SparseReader(generator.sensor, variant, source=load_sensor(request.task))
    return ScanReader(generator.sensor, variant, partial=completes and request.task in ("returns", "label"))


def _read_scan(request: SampleRequest, generator: Generator, reader: ScanReader) -> InputScan:
    """Simulate an example, or read an uploaded file, and project it; messages name no path on the server."""
    path = Path(request.file)
    try:
        if request.example:
            scan = _example(EXAMPLES[request.example], generator.sensor)
        else:
            scan = formats.read_scan(path, bad_points="drop")
        scan = dataclasses.replace(scan, source=request.name)
    except LidarGritError as error:
        error = error.as_left_out() if isinstance(error, ScanError) else error  # there is no option to leave it out
        parts = [
            part.replace(str(path), request.name).replace(path.name, request.name)
            for part in (error.got, error.wanted, error.cure)
        ]
        if ":/" in error.cure:  # of HDF5: the page offers no choice of a dataset
            parts[2] = "keep one dataset of points in the file"
        raise type(error)(*parts) from None
    try:
        return reader.read(scan)
    except LidarGritError as error:
        if not any(words in error.cure for words in _NOT_ON_THE_PAGE):
            raise
        raise type(error)(error.got, error.wanted, _cure_on_the_page(request, generator, scan)) from None


def _example(example: Example, sensor: SensorModel) -> Scan:
    sensor = load_sensor(example.sensor) if example.sensor else sensor
    if not example.every_beam_returns:
        return simulate(_EXAMPLE_SEED, sensor)
    setup = dataclasses.replace(
        setup_of(sensor, np.random.default_rng(_EXAMPLE_SEED)), firing_jitter_rad=0.0, split_exponent=0.0
    )
    return simulate(_EXAMPLE_SEED, dataclasses.replace(sensor, setup=setup), model=RaydropModel(least_power=_NO_POWER))


def _cure_on_the_page(request: SampleRequest, generator: Generator, scan: Scan) -> str:
    """Return what somebody can do on the page about a scan that another sensor made, or that has other rows."""
    if request.task in UPSAMPLED:
        return "choose the task that names the sensor of the scan, or choose another scan"
    if has_few_rings(scan, generator.sensor):
        rings = ring_count(scan)
        tasks = [task for task in UPSAMPLED if load_sensor(task).height == rings and _can(generator, task)]
        if tasks:
            return f"choose the task {one_of([repr(TASKS[task]) for task in tasks])}, or a model of the scan's sensor"
    return "choose a model of the sensor that made the scan, or choose another scan"


def _observed(request: SampleRequest, seen: InputScan) -> Bool[Tensor, "H W"]:
    if request.task in UPSAMPLED:
        return observed_rows(seen)
    if request.task == "region":
        height, width = seen.image.range_m.shape
        left, top, right, bottom = request.region
        observed = torch.ones(height, width, dtype=torch.bool)
        rows = slice(math.floor(top * height), math.ceil(bottom * height))
        observed[rows, math.floor(left * width) : math.ceil(right * width)] = False
        return observed
    pattern = {"returns": "returns", "ahead": "sector:45,315", "rows": "rows:4"}[request.task]
    try:
        return Pattern(pattern).mask(seen.image)
    except UsageError:  # the messages of patterns name options of the command line
        got, wanted = f"{request.name}, in which every ray has a return", "some rays to fill in"
    except ScanError:
        got, wanted = f"{request.name} without a return outside the part to fill in", "some returns there"
    raise ScanError(got, wanted, "choose another task, or another scan")


def _answer_request(model: _Served, request: SampleRequest, folder: Path) -> dict[str, Any]:
    try:
        sets = compute_result(model.generator, request, model.variant, model.segmenter)
        pixels: dict[str, Any] = {}
        for index, scans in enumerate(sets):
            pixels[f"range_m_{index}"] = scans.images.range_m.numpy()
            for name, plane in scans.images.planes.items():
                pixels[f"{name}_{index}"] = plane.numpy()
        try:
            write_text(folder / PAGE_FILE, json.dumps(page_data(sets)))
            with atomic_path(folder / PIXELS_FILE) as temporary, temporary.open("wb") as file:
                np.savez(file, **pixels)
        except OutputError:  # its message names a folder of the server
            raise NO_ROOM from None
    except LidarGritError as error:
        return {"error": str(error)}
    except Exception as error:  # the process is to go on, whatever error a network or a library raises
        traceback.print_exc()
        got = f"an error of the program ({kind_and_words(error)})"
        return {"error": str(ConfigError(got, "a result", "try other settings, and report it"))}
    return {"done": True}


def _send(answers: TextIO, message: dict[str, Any]) -> None:
    print(json.dumps(message), file=answers, flush=True)

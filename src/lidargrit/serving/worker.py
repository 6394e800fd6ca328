"""Wishes → range images on disk, in a process of its own that can be ended at any moment.

It reads a request a line and answers a line, both JSON: no pickle passes, and the process that serves strangers never
computes. A scan that takes too long, or takes the memory, is ended with its process, and the next one begins anew.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from lidargrit import formats
from lidargrit.errors import ConfigError, LidarGritError, ScanError
from lidargrit.files import write_text
from lidargrit.generators import Generator, load
from lidargrit.projection import project
from lidargrit.sensors import SensorModel
from lidargrit.serving.requests import SampleRequest, sampling_settings
from lidargrit.structures import RangeImage
from lidargrit.viewer.interactive import told
from lidargrit.viewer.scan_sets import ScanSet

PAGE_FILE, PIXELS_FILE = "told.json", "pixels.npz"  # of a result: for the page, and for files to save


def run_worker(runs: Sequence[Path], device: str) -> None:
    """Say what the runs can do, then fulfil requests from standard input until it ends."""
    answers = sys.stdout
    sys.stdout = sys.stderr  # whatever a library prints is no answer
    try:
        generators = [load(run).to(device or ("cuda" if torch.cuda.is_available() else "cpu")) for run in runs]
    except LidarGritError as error:
        _say(answers, {"error": [type(error).__name__, error.got, error.wanted, error.cure]})
        return
    except (RuntimeError, AssertionError) as error:  # torch's ways to say: no such device, or not in this build
        _say(answers, {"error": ["ConfigError", f"--device {device} ({_first(error)})", "cpu or cuda", "leave it out"]})
        return
    _say(
        answers,
        {"models": [describe_model(run.resolve().name, one) for run, one in zip(runs, generators, strict=True)]},
    )
    for line in sys.stdin:
        asked = json.loads(line)
        request = SampleRequest(**asked["request"])
        _say(answers, _answer_request(generators[request.model], request, Path(asked["folder"])))


def describe_model(name: str, generator: Generator) -> dict[str, Any]:
    """Return what a page needs to know of a model."""
    sensor = generator.sensor
    return {
        "name": name,
        "generator": generator.public_name(),
        "sensor": f"{sensor.name}, {sensor.height} x {sensor.width}",
        "upload": next((able for able in ("complete", "encode") if able in generator.capabilities), ""),
        "settings": [dataclasses.asdict(setting) for setting in sampling_settings(generator.Sampling())],
        "rays": sensor.to_json(),
    }


def compute_result(generator: Generator, request: SampleRequest) -> list[ScanSet]:
    """Draw what is wanted: new scans, or what the model makes of an uploaded one.

    Raises:
        LidarGritError: a file that cannot be used, or a setting out of its bounds.
    """
    # What nobody touched is left to the generator, which may complete by other numbers than it samples by.
    sampling = dataclasses.replace(generator.Sampling(), **request.sampling) if request.sampling else None
    device = next(iter(generator.state_dict().values())).device
    if not request.file:
        seeds = range(request.seed, request.seed + request.count)
        names = tuple(f"seed {seed}" for seed in seeds)
        return [ScanSet("generated", generator.sample(seeds, sampling).to("cpu"), names)]
    image = _uploaded(request, generator.sensor, partial="complete" in generator.capabilities)
    shown = [ScanSet("as uploaded", image, (request.name,))]
    image = image.to(device)
    if "complete" not in generator.capabilities:
        return [*shown, ScanSet("reconstructed", generator.reconstruct(image).to("cpu"), (request.name,))]
    hidden = _hidden(request.hidden, image)
    if request.hidden != "nothing":
        shown.append(ScanSet("what the model saw", _without(image, hidden).to("cpu"), (request.name,)))
    seeds = range(request.seed, request.seed + request.count)
    images = RangeImage.stack([image[0]] * request.count)
    drawn = generator.complete(images, ~hidden.expand_as(images.return_mask), seeds, sampling)
    return [*shown, ScanSet("completed", drawn.to("cpu"), tuple(f"{request.name}, seed {seed}" for seed in seeds))]


def _uploaded(request: SampleRequest, sensor: SensorModel, partial: bool) -> RangeImage:
    """Read and project a file, whose place no message names; of a scan without rings, rows are told by elevation."""
    path = Path(request.file)
    try:
        scan = dataclasses.replace(formats.read_scan(path, bad_points="drop"), source=request.name)
        try:
            image = project(scan, sensor, partial=partial)
        except ScanError:
            if sensor.projection == "spherical":
                raise
            with contextlib.suppress(ScanError):
                return RangeImage.stack([project(scan, sensor, "spherical", partial=partial)])
            raise
    except LidarGritError as error:
        told = [part.replace(str(path), request.name) for part in (error.got, error.wanted, error.cure)]
        raise type(error)(*told) from None
    return RangeImage.stack([image])


def _hidden(what: str, image: RangeImage) -> Bool[Tensor, "1 H W"]:
    """Return the pixels that the model is to make up."""
    if what == "nothing":
        return ~image.return_mask
    hidden = torch.zeros_like(image.return_mask)
    if what == "ahead":
        azimuth_rad = image.sensor.azimuth_rad.to(hidden.device).expand(hidden.shape[1:])
        return (azimuth_rad.cos() > 0.5**0.5)[None]
    hidden[:, torch.arange(hidden.shape[1]) % 4 != 0] = True
    return hidden


def _without(image: RangeImage, hidden: Bool[Tensor, "1 H W"]) -> RangeImage:
    kept = image.return_mask & ~hidden
    reflectance = None if image.reflectance is None else image.reflectance * kept
    return RangeImage(image.range_m * kept, kept, image.sensor, reflectance)


def _answer_request(generator: Generator, request: SampleRequest, folder: Path) -> dict[str, Any]:
    """Write a result into a folder, and return what is to be answered."""
    try:
        shown = compute_result(generator, request)
        write_text(folder / PAGE_FILE, json.dumps(told(shown)))
        pixels: dict[str, Any] = {}
        for place, one in enumerate(shown):
            pixels[f"range_m_{place}"] = one.images.range_m.numpy()
            if one.images.reflectance is not None:
                pixels[f"reflectance_{place}"] = one.images.reflectance.numpy()
        np.savez(folder / PIXELS_FILE, **pixels)
    except LidarGritError as error:
        return {"refused": str(error)}
    except Exception as error:  # the process is to live on, whatever a network or a library stumbles over
        traceback.print_exc()
        unfit = ConfigError(
            f"an error of the program ({_first(error)})", "a result", "try other settings, and report it"
        )
        return {"refused": str(unfit)}
    return {"done": True}


def _first(error: Exception) -> str:
    return f"{type(error).__name__}: {str(error).partition(os.linesep)[0][:100]}"


def _say(answers: Any, what: dict[str, Any]) -> None:
    answers.write(json.dumps(what) + "\n")
    answers.flush()

"""One leg of a relay: a run folder and some minutes → its stages trained further on streets that are made meanwhile.

The first stage comes first: tokenizer, then the pixel decoder over it, then the prior over its tokens.
"""

import json
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from packing import RELAY_FILE, round_finished
from streets import Streets, ValidationStreets, simulating
from upright_objects import kept_objects

from lidargrit.core.determinism import derive_seed
from lidargrit.core.errors import OutputError, Terminated
from lidargrit.core.files import read_json, write_json
from lidargrit.generation.generator import Generator
from lidargrit.generation.pixel_decoder.pixel_decoder import PixelDecoder
from lidargrit.generation.presets import load_preset
from lidargrit.generation.settings import Preset
from lidargrit.generation.tokens import TokenGenerator
from lidargrit.scans.types import RangeImage
from lidargrit.training.checkpoint import fingerprint
from lidargrit.training.stage import StageTraining

_FIRST_STAGE = ("tokenizer", "pixels")
_VALIDATION_SEED = 1_000_000  # the simulator's first validation street
_POOL_AT_MOST = 8  # processes that simulate the validation streets
_FOR_JUDGING_S = 15.0
_LEAST_TRAINING_S = 5.0


@dataclass(frozen=True)
class Leg:
    """What one leg is given.

    Args:
        preset: name of the preset that is trained.
        run: folder of the relay.
        seconds: time that the leg may take, saving and packing left out.
        processes: number of processes that simulate streets.
        validation_streets: number of streets on which the leg is judged.
    """

    preset: str
    run: Path
    seconds: float
    processes: int
    validation_streets: int = 24


def run_leg(leg: Leg, preset: Preset | None = None, saved: Callable[[], None] = lambda: None) -> None:
    """Train the stages in turn until the time is over, and note in ``relay.json`` what was reached.

    Args:
        leg: what the leg is given.
        preset: settings to train in place of those of that name.
        saved: called once all is trained and saved, before it is judged, which may outlast the machine.

    Raises:
        OutputError: the folder holds the relay of another preset.
    """
    begun = time.monotonic()
    preset = preset or load_preset(leg.preset)
    state, sensor, generator = _state(leg), preset.data.load_sensor(), preset.build_generator()
    columns = (sensor.width * sensor.column_stride, sensor.column_stride)
    folder = leg.run / "streets"
    with (
        ProcessPoolExecutor(min(leg.processes, _POOL_AT_MOST), get_context("spawn")) as pool,
        simulating(folder, preset.data.sensor, columns, state["next_seed"], leg.processes),
    ):
        seeds = range(_VALIDATION_SEED, _VALIDATION_SEED + leg.validation_streets)
        streets, validation = Streets(folder), ValidationStreets(sensor, seeds, pool)
        deadline_s = begun + leg.seconds - _FOR_JUDGING_S
        trained, finished = _train(generator, preset, leg.run, deadline_s, streets, validation)
    told: dict[str, float] = {"seconds": time.monotonic() - begun, "streets": streets.count}
    state |= {"next_seed": streets.next_seed(state["next_seed"]), "finished": finished}
    state["legs"].append(told)
    write_json(leg.run / RELAY_FILE, state)
    saved()
    for stage, (fit, scans) in trained.items():
        told |= {f"{stage}.scans": fit.scans_seen, f"{stage}.scans_of_leg": scans}
        if scans:
            losses = fit.validate(validation.images())
            judged = _judged(generator, stage, validation.labelled, fit.engine.device)
            told |= {f"{stage}.{name}": round(value, 5) for name, value in (*losses.items(), *judged)}
    write_json(leg.run / RELAY_FILE, state)
    print(json.dumps(state["legs"][-1]), flush=True)


def _train(
    generator: Generator,
    preset: Preset,
    run: Path,
    deadline_s: float,
    streets: Streets,
    validation: ValidationStreets,
) -> tuple[dict[str, tuple[StageTraining, int]], list[str]]:
    """Train until the time is over; return each stage begun with the scans of this leg, and the finished stages."""
    trained: dict[str, tuple[StageTraining, int]] = {}
    finished: list[str] = []
    for stage in _in_order(generator):
        fit = _fit(generator, preset, stage, run, finished, deadline_s)
        before = fit.scans_seen
        if deadline_s - time.monotonic() < _LEAST_TRAINING_S and before < fit.config.scans:
            break
        try:
            fit.run(streets.images(generator.sensor), validation.images(), f"training {stage}")
            finished.append(stage)
            round_finished(fit.average.objective)
        except Terminated:
            pass
        trained[stage] = fit, fit.scans_seen - before
        generator.load_stage(stage, fit.average.objective)
        if stage not in finished:
            break
    return trained, finished


def _state(leg: Leg) -> dict[str, Any]:
    path = leg.run / RELAY_FILE
    state = read_json(path) if path.exists() else {"preset": leg.preset, "next_seed": 0, "finished": [], "legs": []}
    if state["preset"] != leg.preset:
        raise OutputError(f"{leg.run}, the relay of {state['preset']}", leg.preset, "take another folder")
    write_json(path, state)
    return state


def _in_order(generator: Generator) -> tuple[str, ...]:
    first = tuple(stage for stage in _FIRST_STAGE if stage in generator.stages)
    return first + tuple(stage for stage in generator.stages if stage not in first)


def _fit(
    generator: Generator, preset: Preset, stage: str, run: Path, finished: list[str], deadline_s: float
) -> StageTraining:
    seed = derive_seed(preset.seed, generator.stages.index(stage))
    torch.manual_seed(seed)
    built_on = fingerprint(generator.objective("tokenizer")) if finished else ""
    objective, config, workers = generator.objective(stage), preset.settings_of(stage), preset.data.workers
    stage_training = StageTraining(objective, config, run / stage, seed, built_on, workers, deadline_s=deadline_s)
    return stage_training.begun()


@torch.no_grad()
def _judged(generator: Generator, stage: str, truth: RangeImage, device: torch.device) -> Iterator[tuple[str, float]]:
    """Yield what the first stage keeps of streets: ranges, and poles and trunks where they stood."""
    generator.to(device).eval()
    if not isinstance(generator, TokenGenerator) or stage not in _FIRST_STAGE:
        return
    whole = RangeImage.cat(
        [_from_tokens(generator, stage, truth[[index]].to(device), index) for index in range(len(truth))]
    )
    both = truth.return_mask & whole.return_mask
    error_m = (whole.range_m - truth.range_m).abs()
    kept = kept_objects(truth, whole)
    yield "kept_poles", float(kept.kept)
    yield "poles", float(kept.total)
    yield "share_of_pole_pixels", kept.share_of_pixels
    yield "within_5_percent", float(((error_m <= 0.05 * truth.range_m) & both).sum() / truth.return_mask.sum())
    yield "range_mae_m", float(error_m[both].mean())
    yield "mask_agrees", float((truth.return_mask == whole.return_mask).float().mean())


def _from_tokens(generator: TokenGenerator, stage: str, image: RangeImage, seed: int) -> RangeImage:
    """Return what a scan's own tokens decode to, or what the pixel decoder samples from them once it is trained."""
    tokenizer = generator.get_tokenizer()
    decoded, pixels = tokenizer.decode(tokenizer.encode(image)), generator.pixels
    if stage == "pixels" and isinstance(pixels, PixelDecoder):
        return pixels.sample(decoded, [torch.Generator().manual_seed(seed)]).to("cpu")
    return decoded.threshold().to("cpu")

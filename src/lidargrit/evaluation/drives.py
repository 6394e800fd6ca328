"""Drives → tables: errors of forecasts of their scans, and how well scans that follow one another fit together."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, fields, replace
from statistics import median
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64
from torch import Tensor

from lidargrit.core import reporting
from lidargrit.core.determinism import evenly_spaced, scan_seed
from lidargrit.core.errors import ConfigError, DataError, counted_scans
from lidargrit.core.table import Table, render
from lidargrit.data.images import RangeImages
from lidargrit.data.pasts import Pasts
from lidargrit.data.sources import open_source
from lidargrit.evaluation.drive_errors import (
    ErrorsOfForecast,
    consistency_chamfer_m2,
    consistency_error_m,
    forecast_errors,
    gem_errors,
)
from lidargrit.evaluation.evaluate import EvalConfig
from lidargrit.evaluation.intervals import Estimate
from lidargrit.evaluation.odometry import INSTALL, SETTLING_SCANS, kiss_icp_is_there, path_by_kiss_icp, path_errors
from lidargrit.evaluation.protocols import load_protocol, public_name
from lidargrit.generation.generator import Generator, load
from lidargrit.generation.pixel_decoder.pixel_decoder import PixelSampling
from lidargrit.scans.motion import transform_between
from lidargrit.scans.past import Past
from lidargrit.scans.projection import points_of_pixels
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage
from lidargrit.scans.warp import warp

_PAST_SCANS = 5  # of forecasts without a model
_STANDS_M_PER_S = 0.5  # below, a forecast is as good as the last scan
_LONGEST_OFF = 0.25  # of a horizon, by which the nearest whole number of steps may miss it
_TTCE_STEPS, _CTC_STEPS = (3, 4), (1, 2, 3, 4)
Measure = Callable[[np.ndarray, np.ndarray, np.ndarray], float]  # of an earlier and a later scan, and their transform
ErrorsOf = Callable[[Float64[Tensor, "H W"], Float64[Tensor, "H W"], SensorModel], ErrorsOfForecast]


@dataclass(frozen=True)
class _Measured:
    """What a protocol measures of forecasts.

    Args:
        horizons_s: groups of seconds ahead; errors are means over all of a group.
        errors: function from a forecast, the scan that came and their sensor to errors.
        heads: titles of the errors.
    """

    horizons_s: tuple[tuple[float, ...], ...]
    errors: ErrorsOf
    heads: tuple[str, ...]


MEASURED = {
    "forecast": _Measured(
        ((0.1,), (0.5,), (1.0,), (3.0,)),
        forecast_errors,
        ("L1 [m]", "AbsRel", "median [m]", "covered", "mask right", "chamfer [m2]"),
    ),
    "gem": _Measured(
        ((0.2, 0.4, 0.6, 0.8, 1.0), (0.6, 1.2, 1.8, 2.4, 3.0)),
        gem_errors,
        ("chamfer, drops matched [m2]", "the same in its box [m2]", "returns alone [m2]", "drops"),
    ),
}
"""Protocols of forecasts, by their names."""
DRIVE = "drive"
"""The protocol of how well scans of a drive fit together."""


@dataclass(frozen=True, eq=False)
class _Drives:
    images: RangeImages
    pasts: Pasts

    @classmethod
    def of(cls, text: str, config: EvalConfig, model: Generator | None = None) -> "_Drives":
        source = open_source(text, config.data.bad_points)
        data = replace(config.data_config(), max_scans=0)
        name = config.sensor or load_protocol(config.protocol).sensor
        named = replace(data, sensor=name).load_sensor() if name else None
        images = source.images(model.sensor if model else named, source.as_projected(data))
        return cls(images, Pasts(images, model.past_scans if model else _PAST_SCANS))

    def windows(self, horizon_s: float, at_most: int) -> list[tuple[int, int]]:
        """Return scans that are so many seconds after a whole past, each with the steps to the latest one."""
        found = []
        for drive in self.pasts.drives:
            times_s = [self.pasts.motion(number).time_s or 0.0 for number in drive]
            if len(drive) < 2:
                continue
            period_s = median(np.diff(times_s))
            gap = max(1, round(horizon_s / period_s))
            if abs(gap * period_s - horizon_s) <= _LONGEST_OFF * horizon_s:
                found += [(number, gap) for number in drive[gap + self.pasts.count - 1 :]]
        return [found[at] for at in evenly_spaced(at_most or len(found), len(found))]


def evaluate_forecast(source: str, config: EvalConfig, model: str = "") -> tuple[str, dict[str, Any]]:
    """Forecast scans of drives from those before them, whose poses and their own are known.

    They are as many as the model takes, and five without one.

    Scans of a car that stands are left out. Besides the model, these are forecast: ``copied``, the last scan;
    ``warped``, its returns moved by the car's motion; ``warped_cache``, those of all past scans; and, given two
    or more, the same by the poses that follow from a constant speed.

    Args:
        model: run of a generator that takes a past; none if empty.

    Returns:
        a table for each horizon, and their plain values.
    """
    generator = _forecaster(model, config.device) if model else None
    drives = _Drives.of(source, config, generator)
    named = public_name(config.protocol)
    measured, tables, values = MEASURED[named], [], []
    for horizons_s in measured.horizons_s:
        errors, standing = _errors_at(drives, horizons_s, config.max_scans, measured.errors, generator, model)
        title = f"{', '.join(f'{each:g}' for each in horizons_s)} s ahead"
        count = len(next(iter(errors.values()), []))
        if not count:
            lacking = f"{title}: no drive of {source} moves and is so long, with {drives.pasts.count} scans before"
            tables.append(Table(sentences=(lacking,)))
            continue
        rows = {name: _estimates(each) for name, each in errors.items()}
        left_out = (f"{counted_scans(standing)} of a standing car left out",) if standing else ()
        cells = tuple((name, *(each.as_text(".3f") for each in row.values())) for name, row in rows.items())
        tables.append(Table(("forecast", *measured.heads), cells, f"{title}: {counted_scans(count)}", notes=left_out))
        plain = {name: {key: vars(each) for key, each in row.items()} for name, row in rows.items()}
        at = {"horizon_s": horizons_s[-1], "horizons_s": list(horizons_s)}
        values.append({**at, "scans": count, "standing": standing, "forecasts": plain})
    if not values:
        cure = "name longer ones: lidargrit simulate DRIVES --frames 12 -n 120"
        got = f"drives of {source} of which none moves for {drives.pasts.count + 1} scans"
        raise DataError(got, "longer drives", cure)
    departures = load_protocol(named).departures
    tables.append(Table(sentences=tuple(f"differs from its source: {each}" for each in departures)))
    about = {"protocol": named, "samples": source, "model": model, "settings": config.facts()}
    return render(tables), {**about, "departures": list(departures), "horizons": values}


def _forecaster(model: str, device: str) -> Generator:
    generator = load(model, "drive", device)
    if not generator.past_scans:
        got = f"the model {model}, which takes no past"
        raise ConfigError(got, "one that forecasts", "leave --model out, or train one with data.condition=past")
    return generator


def _errors_at(
    drives: _Drives,
    horizons_s: Sequence[float],
    at_most: int,
    errors: ErrorsOf,
    generator: Generator | None,
    model: str,
) -> tuple[Mapping[str, list[ErrorsOfForecast]], int]:
    """Return the errors of every forecast at some horizons, and how many scans of a standing car were left out."""
    found, standing = dict[str, list[ErrorsOfForecast]](), 0
    windows = [window for horizon_s in horizons_s for window in drives.windows(horizon_s, at_most)]
    with reporting.progress(f"forecasting {horizons_s[-1]:g} s", len(windows)) as progress:
        for number, gap in windows:
            past = drives.pasts.of([number], gaps=[gap])
            progress.advance(1)
            if float(past.transforms[0, -1, :3, 3].norm()) < _STANDS_M_PER_S * float(past.ages_s[0, -1]):
                standing += 1
                continue
            true_m = drives.images.batch([number]).range_m[0].double()
            forecasts = baselines(past, gap)
            if generator is not None:
                made = generator.sample([scan_seed(0, number)], past)
                forecasts[model] = made.range_m[0].double().cpu()
                if generator.Sampling is PixelSampling:
                    made = generator.sample([scan_seed(0, number)], past, PixelSampling(point=True))
                    forecasts[f"{model}, sampling.point=true"] = made.range_m[0].double().cpu()
            for name, range_m in forecasts.items():
                found.setdefault(name, []).append(errors(range_m, true_m, drives.images.sensor))
    return found, standing


def baselines(past: Past, gap: int) -> dict[str, Float64[Tensor, "H W"]]:
    """Return forecasts of one scan in metres without a model, by their names; 0 where nothing returns.

    Args:
        past: past of one scan.
        gap: steps from the latest past scan to the one that is forecast.
    """
    warped = warp(past)
    found = {
        "copied": warped.copied_m[0],
        "warped": warped.last.range_m[0],
        "warped_cache": warped.nearest.range_m[0],
    }
    if past.range_m.shape[1] > 1:  # one scan alone tells no speed
        found["warped_cache, constant speed"] = warp(constant_speed(past, gap)).nearest.range_m[0]
    return found


def constant_speed(past: Past, gap: int) -> Past:
    """Return the past as it would be if the sensor went on as in its last step, for that many steps.

    Args:
        past: past of two scans or more.
    """
    to_latest = torch.linalg.inv(past.transforms[:, -1:]) @ past.transforms
    step = to_latest[:, -2:-1]  # from the frame before the latest one to that
    return replace(past, transforms=torch.linalg.matrix_power(step, gap) @ to_latest)


def _estimates(errors: Sequence[ErrorsOfForecast]) -> dict[str, Estimate]:
    columns = zip(*(astuple(one) for one in errors), strict=True)
    return {each.name: Estimate.of(column) for each, column in zip(fields(errors[0]), columns, strict=True)}


def evaluate_drives(sources: Sequence[str], config: EvalConfig) -> tuple[str, dict[str, Any]]:
    """Measure how well scans of drives fit together by their poses: generated drives beside recorded ones.

    Where KISS-ICP is installed, the path that it makes of each drive is compared with the poses, too.

    Returns:
        a table with a row for each source, and its plain values.
    """
    head = ["drives", "scans", *(f"TTCE {steps} [m]" for steps in _TTCE_STEPS), *(f"CTC {n} [m2]" for n in _CTC_STEPS)]
    rows, values, has_odometry = [], [], kiss_icp_is_there()
    for text in sources:
        drives = _Drives.of(text, config)
        ttce = [_fits(drives, steps, config.max_scans, consistency_error_m) for steps in _TTCE_STEPS]
        ctc = [_fits(drives, steps, config.max_scans, consistency_chamfer_m2) for steps in _CTC_STEPS]
        count = sum(len(drive) for drive in drives.pasts.drives)
        row = {"drives": text, "scans": count, "ttce_m": [*map(vars, ttce)], "ctc_m2": [*map(vars, ctc)]}
        cells = [each.as_text(".3f") for each in (*ttce, *ctc)]
        if has_odometry:
            step_m, drift = _odometry(drives, config.max_scans)
            cells += [step_m.as_text(".3f"), drift.as_text(".1%")]
            row |= {"odometry_step_m": vars(step_m), "odometry_drift": vars(drift)}
        rows.append((text, str(count), *cells))
        values.append(row)
    told = (
        f"odometry: KISS-ICP's, of moving drives of {SETTLING_SCANS + 2} scans or more, from scan {SETTLING_SCANS} on"
    )
    lacking = f"no odometry without KISS-ICP: {INSTALL}"
    head += ["odometry, a step [m]", "its drift"] if has_odometry else []
    table = Table(tuple(head), tuple(rows), notes=(told if has_odometry else lacking,))
    return render([table]), {"protocol": DRIVE, "settings": config.facts(), "sets": values}


def _odometry(drives: _Drives, at_most: int) -> tuple[Estimate, Estimate]:
    """Return by how much the path of KISS-ICP is off the poses: at each step in metres, and as a share of the way."""
    long = [drive for drive in drives.pasts.drives if len(drive) > SETTLING_SCANS + 1]
    chosen = [long[at] for at in evenly_spaced(at_most or len(long), len(long))]
    steps_m, drifts = list[float](), list[float]()
    with reporting.progress("odometry", sum(map(len, chosen))) as progress:
        for drive in chosen:
            poses = [pose for number in drive if (pose := drives.pasts.motion(number).pose) is not None]
            estimated = path_by_kiss_icp(_scans_m(drives.images, drive, progress))
            errors = path_errors(estimated, torch.stack(poses).numpy())
            steps_m += errors.steps_m
            drifts.append(errors.drift)
    return Estimate.of(steps_m), Estimate.of(drifts)


def _fits(drives: _Drives, steps: int, at_most: int, measure: Measure) -> Estimate:
    """Return the mean over pairs of scans so many steps apart of what is measured of them."""
    pairs = [(one, later) for drive in drives.pasts.drives for one, later in zip(drive, drive[steps:], strict=False)]
    chosen = [pairs[at] for at in evenly_spaced(at_most or len(pairs), len(pairs))]
    values = []
    with reporting.progress(f"pairs {steps} apart", len(chosen)) as progress:
        for one, later in chosen:
            images = drives.images.batch([one, later])
            then, now = drives.pasts.motion(one).pose, drives.pasts.motion(later).pose
            if then is not None and now is not None:  # as in all drives
                transform = transform_between(then, now).numpy()
                values.append(measure(_points_m(images[0]), _points_m(images[1]), transform))
            progress.advance(1)
    return Estimate.of(values)


def _scans_m(
    images: RangeImages, numbers: Sequence[int], progress: reporting.Progress
) -> Iterator[Float64[np.ndarray, "_ 3"]]:
    for number in numbers:
        yield _points_m(images.batch([number])[0])
        progress.advance(1)


def _points_m(image: RangeImage) -> Float64[np.ndarray, "n 3"]:
    return points_of_pixels(image)[image.return_mask].double().numpy()

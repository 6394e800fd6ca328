"""Find the numbers of the raydrop model and of a set-up that bring simulated scans nearest to real ones by curves.

    python benchmarks/fit_raydrop.py TRAIN [TRAIN ...] [--val VAL] [--scans 48] [--rounds 3] [--json FILE]

Rays are cast once a scene; the physics is then sampled again for every trial with the same random numbers, so that two
trials differ by their parameters alone. Each round first fits the 64 lasers, whose rows do not depend on one another,
then moves one parameter after the other up and down, and keeps a move that lowers the sum of the Jensen-Shannon
distances to the TRAIN scans; steps shrink from round to round. Scans named by --val are only looked at in the end, with
simulated scenes of other seeds. Seeds below 10,000 are used for neither. No rounds: the model as it is, compared.
"""

import argparse
import copy
import json
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.sources import load_range_images
from lidargrit.evaluation.metrics import load_metric
from lidargrit.evaluation.metrics.shared.curves import divergence
from lidargrit.evaluation.realism import CURVES, SimulatedScans, compare, pair_of, simulate_pair, tables
from lidargrit.scans.sensors import SensorModel, SensorSetup, load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.simulator import observation
from lidargrit.simulator.power import RaydropModel
from lidargrit.simulator.scene import sample_scene
from lidargrit.simulator.setups import setup_of
from lidargrit.simulator.tracing import Hits, Tracer, in_reach

_GEOMETRY = ("range_histogram_per_ring", "bev_occupancy", "wall_straightness", "point_cloud_jsd")
FITTED = [name for name in CURVES if name not in _GEOMETRY]
# First step: the factor by which a parameter, or one of a material, is multiplied or divided, or what is added to it.
# Paint is left out: cars are a small share of all points, and a fit of it made dark bodies return at grazing incidence.
FACTORS = {
    "near_m": 1.5,
    "patch_spread": 1.6,
    "patch_deg": 1.8,
    "object_spread": 1.8,
    "pulse_spread": 2.0,
    **{f"{name}.diffuse": 1.4 for name in ("asphalt", "concrete", "plaster", "brick", "leaves", "grass")},
    "foil.retroreflection": 2.0,
    "glass.diffuse": 3.0,
    "glass_passes": 1.8,
}
ADDENDS = {"dim_level": 0.5, "bright_level": 0.7, "dim_share": 0.1}
FIRST_SEED, VAL_SEED = 20_000, 10_000
GAINS = np.arange(-2.4, 0.81, 0.1)  # with more, roads return from farther away than in KITTI, for want of buildings
READINGS = np.arange(0.6, 1.41, 0.05)
RATE_WEIGHT = 4.0  # of a row's divergence of returns over that of reflectance, which is some twenty times as large
PULL = 3e-4  # towards 0, a unit of log gain or a third of one of log reading: as much as a rate of returns off by 0.01


@dataclass(frozen=True)
class Trial:
    """What is fitted: numbers that all sensors share, and those of one unit."""

    model: RaydropModel
    setup: SensorSetup


class Remembering(Tracer):
    """Casts the first time, and then tells again what the rays met: they are always the same."""

    def __init__(self, *arguments) -> None:
        super().__init__(*arguments)
        self.hits: list[Hits] = []
        self.casts = 0

    def cast(self, origins_m, directions, beyond_m=None):
        if self.casts == len(self.hits):
            self.hits.append(super().cast(origins_m, directions, beyond_m))
        hits = self.hits[self.casts]
        self.casts += 1
        return Hits(hits.range_m.copy(), hits.triangle.copy(), hits.cos_incidence.copy())


class Street:
    """One scene whose rays are cast when it is first looked at; its random numbers stay the same too."""

    def __init__(self, seed: int, sensor: SensorModel) -> None:
        street_rng, beam_rng = np.random.default_rng(seed).spawn(2)
        self.sensor, self.scene, self.rngs = sensor, sample_scene(street_rng), (street_rng, beam_rng)
        self.mesh, self.tracer = None, None

    def sample(self, trial: Trial) -> tuple[RangeImage, RangeImage]:
        """Return what stands there, and what a trial measures of it."""
        config = observation.ObservationConfig(kept_columns_only=True, model=trial.model)
        sensor = replace(self.sensor, setup=trial.setup)
        with patch.object(observation, "Tracer", self._trace), patch.object(observation, "in_reach", self._reach):
            seen = observation.observe_scene(self.scene, sensor, *copy.deepcopy(self.rngs), config)
        return pair_of(seen, self.sensor)

    def _reach(self, *arguments):
        self.mesh = in_reach(*arguments) if self.mesh is None else self.mesh
        return self.mesh

    def _trace(self, *arguments):
        self.tracer = Remembering(*arguments) if self.tracer is None else self.tracer
        self.tracer.casts = 0
        return self.tracer


def simulated(streets: list[Street], trial: Trial) -> SimulatedScans:
    pairs = [street.sample(trial) for street in streets]
    return SimulatedScans(*(RangeImage.stack(list(side)) for side in zip(*pairs, strict=True)))


class Target:
    """The real scans, counted once."""

    def __init__(self, real) -> None:
        self.metrics = [load_metric(name)() for name in FITTED]
        for metric in self.metrics:
            metric.update(real.batch(range(len(real))), real=True)

    def distances(self, images: RangeImage) -> list[float]:
        found = []
        for metric in copy.deepcopy(self.metrics):
            metric.update(images, real=False)
            found.append(metric.compute().value)
        return found


class Rows:
    """What lasers are fitted to: the share of returns and the reflectance of every row."""

    def __init__(self, returned: np.ndarray, reflectance: np.ndarray) -> None:
        row = np.broadcast_to(np.arange(returned.shape[1])[:, None], returned.shape)[returned]
        self.returned, self.at, self.reflectance = returned, row, reflectance[returned]
        self.height = returned.shape[1]

    @classmethod
    def of(cls, images: RangeImage) -> "Rows":
        assert images.reflectance is not None
        return cls(images.return_mask.numpy(), images.reflectance.numpy())

    def rates(self) -> np.ndarray:
        share = self.returned.mean(axis=(0, 2))
        return np.stack((share, 1 - share), axis=1)

    def histograms(self, factor: float = 1.0) -> np.ndarray:
        """Count in bins of two hundredths, as if all that is read were so much brighter."""
        hundredths = np.rint(np.clip(self.reflectance * np.float32(factor), 0, 0.99) * 100).astype(int)
        return np.bincount(self.at * 50 + hundredths // 2, minlength=self.height * 50).reshape(-1, 50)


def fit_lasers(streets: list[Street], real: Rows, trial: Trial) -> Trial:
    """Find gain and reading of every laser; all rows try the same one at once, and each keeps its best."""
    lasers = real.height
    least, best = np.full(lasers, np.inf), np.zeros((2, lasers))
    rates, histograms = real.rates(), real.histograms()
    for gain in GAINS:
        alike = replace(trial.setup, log_gain=(float(gain),) * lasers, reading=(1.0,) * lasers)
        rows = Rows.of(simulated(streets, replace(trial, setup=alike)).measured)
        of_rates = RATE_WEIGHT * divergence(rows.rates(), rates)
        for reading in READINGS:
            cost = of_rates + divergence(rows.histograms(reading), histograms)
            cost += PULL * (gain**2 + (3 * np.log(reading)) ** 2)
            better = cost < least
            least[better], best[:, better] = cost[better], np.array([[gain], [reading]])
    gains, readings = (tuple(row.round(2).tolist()) for row in best)
    return replace(trial, setup=replace(trial.setup, log_gain=gains, reading=readings))


def value_of(trial: Trial, name: str) -> float:
    material, dot, field = name.partition(".")
    if dot:
        return getattr(next(m for m in trial.model.materials if m.name == material), field)
    return getattr(trial.setup if name == "glass_passes" else trial.model, name)


def with_value(trial: Trial, name: str, value: float) -> Trial:
    material, dot, field = name.partition(".")
    if name == "glass_passes":
        return replace(trial, setup=replace(trial.setup, glass_passes=value))
    if not dot:
        return replace(trial, model=replace(trial.model, **{name: value}))
    changed = (replace(m, **{field: value}) if m.name == material else m for m in trial.model.materials)
    return replace(trial, model=replace(trial.model, materials=tuple(changed)))


def moved(trial: Trial, name: str, up: bool, shrink: float) -> Trial | None:
    """Return a trial with one value moved; None if the move leads out of its bounds."""
    value = value_of(trial, name)
    if name in FACTORS:
        factor = FACTORS[name] ** shrink
        value = value * factor if up else value / factor
    else:
        value += (1 if up else -1) * ADDENDS[name] * shrink
    if name == "glass_passes" and value > 1:
        return None
    found = with_value(trial, name, value)
    return found if found.model.bright_level > found.model.dim_level and found.model.dim_share >= 0 else None


def search(streets: list[Street], target: Target, real: Rows, trial: Trial, rounds: int) -> Trial:
    best = target.distances(simulated(streets, trial).measured)
    print(f"start    {sum(best):.4f}  " + " ".join(f"{value:.4f}" for value in best), flush=True)
    for turn in range(rounds):
        trial = fit_lasers(streets, real, trial)
        best = target.distances(simulated(streets, trial).measured)
        for name in (*FACTORS, *ADDENDS):
            for up in (True, False):
                if (other := moved(trial, name, up, 0.5**turn)) is None:
                    continue
                found = target.distances(simulated(streets, other).measured)
                if sum(found) < sum(best):
                    trial, best = other, found
                    break
        print(f"round {turn}  {sum(best):.4f}  " + " ".join(f"{value:.4f}" for value in best), flush=True)
        print({name: float(f"{value_of(trial, name):.3g}") for name in (*FACTORS, *ADDENDS)}, flush=True)
    return trial


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("train", nargs="+", help="sources of real scans")
    parser.add_argument("--val", help="a source that the fit does not see")
    parser.add_argument("--sensor", default="hdl64e_kitti_odometry")
    parser.add_argument("--scans", type=int, default=48)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", type=Path, help="also write the numbers to this file")
    options = parser.parse_args()
    sensor = load_sensor(options.sensor)
    start = Trial(RaydropModel(), setup_of(sensor, np.random.default_rng(0)))
    config = DataConfig(bad_scans="skip")
    real = load_range_images(tuple(options.train), config, sensor)
    begun = time.perf_counter()
    streets = [Street(seed, sensor) for seed in range(FIRST_SEED, FIRST_SEED + options.scans)]
    assert streets[0].sample(start)[1].range_m.equal(simulate_pair(FIRST_SEED, sensor)[1].range_m)
    print(f"{len(real)} real scans, {len(streets)} scenes sampled in {time.perf_counter() - begun:.0f} s")
    fitted = search(streets, Target(real), Rows.of(real.batch(range(len(real)))), start, options.rounds)
    print(f"gains {fitted.setup.log_gain}\nreadings {fitted.setup.reading}")
    if options.json:
        options.json.write_text(json.dumps(asdict(fitted)))
    held_out = [Street(seed, sensor) for seed in range(VAL_SEED, VAL_SEED + options.scans)]
    for source in filter(None, ("train", options.val)):
        scans = real if source == "train" else load_range_images((source,), config, sensor)
        for what, which in (("before", start), ("after", fitted))[: 2 if options.rounds else 1]:
            (table,) = tables(compare(simulated(held_out, which), scans))
            print(f"\n{source}, {what} the fit, other seeds\n{table.as_text()}")


if __name__ == "__main__":
    main()

"""Which metrics see known damages of streets, with how many scans: ``python benchmarks/damages.py STREETS OUT.csv``.

Streets of both sets are simulated with their labels, into a folder that a later run reads. A metric sees a damage with
n scans if damaged streets score worse against other streets than undamaged ones do, by more than chance: 2.8 standard
deviations of the undamaged scores over ten ways to choose both sets, as verdicts count chance.
"""

import argparse
import copy
import csv
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from scipy import ndimage

from lidargrit.core import discovery
from lidargrit.core.errors import LidarGritError
from lidargrit.core.files import atomic_path
from lidargrit.evaluation.metrics import Metric, load_metric, update_together
from lidargrit.scans.classes import CLASSES
from lidargrit.scans.projection import points_of_pixels, project
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import RangeImage
from lidargrit.simulator import simulate

SENSOR = load_sensor("hdl64e_kitti_odometry")
_FIRST_SEED = 2_000_000  # the simulator's first test street
_BLOCK = 20  # streets whose features are computed together; sets are chosen from blocks
_SHOWN = slice(256, 768)  # columns of a picture, about straight ahead
_WAYS = 10  # of choosing both sets
_NOT_DAMAGED = ("reflectance_histogram",)
_VEHICLE = [number for number, of_class in CLASSES.items() if of_class.learned in (10, 18, 20)]


def blurred(images: RangeImage, columns: int = 3) -> RangeImage:
    """Give each return the mean range of the returns among neighbouring columns."""
    shifts = range(-(columns // 2), columns // 2 + 1)
    total = torch.stack([images.range_m.roll(shift, -1) for shift in shifts]).sum(0)
    count = torch.stack([images.return_mask.roll(shift, -1) for shift in shifts]).sum(0)
    range_m = torch.where(images.return_mask, total / count.clamp(min=1), 0)
    return RangeImage.masked(range_m, images.return_mask, images.sensor, images.planes)


def without_vehicles(images: RangeImage, every: int = 2) -> RangeImage:
    """Drop the returns of every second vehicle, or of every n-th."""
    gone, number = torch.zeros_like(images.return_mask), 0
    for index in range(len(images)):
        for pixels in vehicles_of(images[index]):
            number += 1
            if number % every == 0:
                gone[index][pixels] = True
    return RangeImage.masked(images.range_m, images.return_mask & ~gone, images.sensor, images.planes)


def boxes_for_vehicles(images: RangeImage) -> RangeImage:
    """Put an upright box of the same length, width and height in the place of each vehicle."""
    ones = torch.ones_like(images.return_mask[0])
    rays = points_of_pixels(RangeImage(ones.float(), ones, images.sensor)).double().numpy()
    made = []
    for image in (images[index] for index in range(len(images))):
        range_m, label, gone = image.range_m.clone(), image.planes["label"].clone(), torch.zeros_like(ones)
        points = points_of_pixels(image).double().numpy()
        for pixels in vehicles_of(image):
            entry_m = torch.from_numpy(_entry_into_box(rays, points[pixels.numpy()]))
            gone |= pixels
            hit = entry_m.isfinite() & (gone | (entry_m < range_m) | ~image.return_mask)
            range_m = torch.where(hit, entry_m.float(), range_m)
            label = torch.where(hit, 10, label)
            gone &= ~hit
        mask = ((image.return_mask & ~gone) | (label == 10)) & (range_m > 0)
        made.append(RangeImage.masked(range_m, mask, images.sensor, {"label": label}))
    return RangeImage.stack(made)


DAMAGES: dict[str, Callable[[RangeImage], RangeImage]] = {
    "ranges blurred over 3 columns": blurred,
    "every second vehicle removed": without_vehicles,
    "boxes in place of vehicles": boxes_for_vehicles,
}


def vehicles_of(image: RangeImage) -> list[torch.Tensor]:
    """Return the pixels of each vehicle of a labelled image: connected ones, at least six."""
    found = np.zeros(image.range_m.shape, np.int64)
    ndimage.label(np.isin(image.planes["label"].numpy(), _VEHICLE) & image.return_mask.numpy(), np.ones((3, 3)), found)
    masks = [torch.from_numpy(found == number) for number in range(1, int(found.max()) + 1)]
    return [mask for mask in masks if int(mask.sum()) >= 6]


def _entry_into_box(rays: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return at which distance each ray from the origin enters the box around points, infinite where it does not."""
    centre = points[:, :2].mean(0)
    _, axes = np.linalg.eigh(np.cov((points[:, :2] - centre).T))
    turn = np.eye(3)
    turn[:2, :2] = axes
    low, high = (points @ turn).min(0), (points @ turn).max(0)
    with np.errstate(divide="ignore"):
        crossings = np.stack((low / (rays @ turn), high / (rays @ turn)))
    enter, leave = crossings.min(0).max(-1), crossings.max(0).min(-1)
    return np.where((enter < leave) & (enter > 0), enter, np.inf)


def _streets(folder: Path, block: int) -> RangeImage:
    path = folder / f"{block:04d}.npz"
    if not path.exists():
        first = _FIRST_SEED + block * _BLOCK
        images = [project(simulate(seed, SENSOR), SENSOR) for seed in range(first, first + _BLOCK)]
        folder.mkdir(parents=True, exist_ok=True)
        whole = RangeImage.stack(images)
        with atomic_path(path) as partial, partial.open("wb") as file:
            np.savez(file, range_m=whole.range_m.numpy(), label=whole.planes["label"].numpy())
    kept = {name: torch.from_numpy(values) for name, values in np.load(path).items()}
    return RangeImage.masked(kept["range_m"], kept["range_m"] > 0, SENSOR, {"label": kept["label"]})


def _metrics() -> list[Metric]:
    """Return every metric that needs no weights from elsewhere, by each of its variants."""
    made = []
    for name in discovery.names("metrics"):
        if name in _NOT_DAMAGED:
            continue
        for variant in load_metric(name).variants:
            try:
                made.append(load_metric(name)(variant=variant))
            except LidarGritError as error:
                print(f"left out: {name} ({variant}): {error}")
    return made


def _fed(folder: Path, block: int) -> tuple[list[Metric], dict[str, list[Metric]]]:
    """Return the metrics fed with one block as real, and with it undamaged and damaged as generated."""
    torch.set_num_threads(1)
    streets = _streets(folder, block)
    real = _metrics()
    update_together([(metric, True) for metric in real], streets)
    made = {}
    for name, damage in {"none": lambda images: images, **DAMAGES}.items():
        made[name] = _metrics()
        update_together([(metric, False) for metric in made[name]], damage(streets))
    return real, made


def _value(parts: Sequence[Metric]) -> float:
    whole = copy.deepcopy(parts[0])
    for part in parts[1:]:
        whole.merge(part)
    return whole.compute().value


def seen(folder: Path, blocks: int, numbers: Sequence[int], processes: int) -> list[dict[str, str | int | float]]:
    """Return a row for each metric, variant, damage and number of scans: by how many deviations it is seen."""
    with ProcessPoolExecutor(processes) as pool:
        fed = list(pool.map(_fed, [folder] * blocks, range(blocks)))
    rows: list[dict[str, str | int | float]] = []
    rng = np.random.default_rng(0)
    for scans in numbers:
        ways = [rng.permutation(blocks)[: 2 * scans // _BLOCK].reshape(2, -1) for _ in range(_WAYS)]
        for index, metric in enumerate(fed[0][0]):
            sign = -1 if metric.higher_is_better else 1
            by_damage = {
                damage: [
                    sign * _value([*(fed[b][1][damage][index] for b in made), *(fed[b][0][index] for b in real)])
                    for made, real in ways
                ]
                for damage in ("none", *DAMAGES)
            }
            spread = max(float(np.std(by_damage["none"], ddof=1)), 1e-12)
            for damage in DAMAGES:
                by = (np.mean(by_damage[damage]) - np.mean(by_damage["none"])) / spread
                row = {"metric": metric.name, "variant": metric.variant, "damage": damage, "scans": scans}
                rows.append({**row, "deviations": round(float(by), 1)})
            print(metric.name, metric.variant, scans, [row["deviations"] for row in rows[-3:]], flush=True)
    return rows


def _plot(path: Path, seed: int) -> None:
    """Plot a street at 64x1024 and its damages, one above the other, in colours of 2 to 80 m."""
    sensor = SENSOR.with_columns(1024)
    street = RangeImage.stack([project(simulate(seed, sensor), sensor)])
    damages = {
        "a simulated street": street,
        "ranges blurred": blurred(street, 5),
        "vehicles removed": without_vehicles(street, 1),
        "boxes as vehicles": boxes_for_vehicles(street),
    }
    figure = Figure(figsize=(9.6, 0.85 * len(damages)), dpi=100)
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(damages), 1, gridspec_kw={"hspace": 0.06})
    for axes, (name, images) in zip(grid, damages.items(), strict=True):
        range_m = images.range_m[0, :, _SHOWN].numpy()
        look = {"cmap": "turbo", "norm": LogNorm(2, 80), "aspect": "auto", "interpolation": "none"}
        axes.imshow(np.where(range_m > 0, range_m, np.nan), **look)
        axes.set(xticks=[], yticks=[])
        axes.set_ylabel(name, rotation=0, ha="right", va="center", fontsize=9)
    figure.subplots_adjust(left=0.15, right=0.998, top=0.99, bottom=0.01)
    figure.savefig(path)


def _main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--picture", type=int, metavar="SEED", help="plot this street and its damages into OUT instead")
    parser.add_argument("streets", type=Path, help="folder that keeps the simulated streets")
    parser.add_argument("out", type=Path)
    parser.add_argument("--scans", type=int, nargs="+", default=[100, 300], help="numbers of scans in each set")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    given = parser.parse_args()
    if given.picture is not None:
        return _plot(given.out, given.picture)
    rows = seen(given.streets, 2 * max(given.scans) // _BLOCK, given.scans, given.processes)
    with atomic_path(given.out) as partial, partial.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    _main()

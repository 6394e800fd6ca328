"""What a model can do with a scan: fill it in, add rows between its own, or drop returns of a clean one."""

import warnings
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch

from lidargrit.core.determinism import derive_seed
from lidargrit.generation.batches import check_seeds
from lidargrit.inference.complete import Model
from lidargrit.inference.complete.cloud import CompletedScan, dropped_scan, filled_scan
from lidargrit.inference.complete.grid import RayGrid, columns_fired
from lidargrit.inference.complete.inputs import InputScan, ScanReader
from lidargrit.inference.complete.patterns import Pattern
from lidargrit.inference.complete.sparse import SparseReader, observed_rows
from lidargrit.scans.condition import ConditionKind, Observed
from lidargrit.scans.many_scans import untold
from lidargrit.scans.projection import ProjectionVariant
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage, Scan

_TRAIN_RAYDROP = "lidargrit train raydrop_compact RUN --set data.sensor=SENSOR"
_doubted = set[str]()  # what callers of the Python API were warned of


class Task(ABC):
    """One of the verbs, as it treats one scan after the other."""

    verb: ClassVar[str]
    progress: ClassVar[str]
    """What progress lines call the work."""
    kind: ClassVar[ConditionKind] = "pixels"
    """Kind of the conditions that the model is given."""
    adds: ClassVar[bool] = True
    """Whether points are added, and not dropped."""

    @abstractmethod
    def reader(self, sensor: SensorModel, variant: ProjectionVariant) -> ScanReader:
        """Return what projects a scan to the rays of a sensor."""

    def grid(self, scan: Scan, model: SensorModel) -> RayGrid:
        """Return the rays of a whole cloud."""
        return RayGrid.fitting(model, *columns_fired(scan))

    def see(self, scan: Scan, model: Model) -> InputScan:
        """Return a cloud on the rays that all of its points lie on."""
        grid = self.grid(scan, model.sensor)
        reader = replace(self.reader(grid.sensor, model.projection_variant), projection=model.projection)
        return replace(reader.read(scan), grid=grid)

    @abstractmethod
    def condition(self, seen: InputScan, seed: int) -> Observed:
        """Return what is known of each image that a scan consists of, the random part of it by a seed."""

    @abstractmethod
    def result(self, seen: InputScan, condition: Observed, images: RangeImage) -> CompletedScan:
        """Return the cloud with what the model made of its images."""

    def sensor_of_points(self, seen: InputScan) -> SensorModel:
        """Return the rays of the completed cloud, with the projection by which its points get their rows."""
        return replace(seen.rays.sensor, projection="unfolding" if seen.by_ring else "spherical")

    def identity(self) -> dict[str, Any]:
        """Return the settings of the task as JSON, by which its files are told from those of others."""
        return {}


@dataclass(frozen=True)
class Fill(Task):
    """Fill in what is not observed.

    Args:
        pattern: choice of the observed pixels.
    """

    pattern: Pattern
    verb: ClassVar[str] = "complete"
    progress: ClassVar[str] = "completing"

    def reader(self, sensor: SensorModel, variant: ProjectionVariant) -> ScanReader:
        """Return one that takes a part of the circle where only returns are observed."""
        return ScanReader(sensor, variant, self.pattern.partial)

    def condition(self, seen: InputScan, seed: int) -> Observed:
        """Return the pixels that the pattern observes."""
        images = seen.rays.images(seen.image)
        source = seen.name if seen.points is None else seen.points.source
        return Observed.of_pixels(images, self.pattern.masks(images, seed, source))

    def result(self, seen: InputScan, condition: Observed, images: RangeImage) -> CompletedScan:
        """Return the measured points with those that were added; those that the pattern hides are left out."""
        return filled_scan(seen, condition, images, hides=not self.pattern.partial)

    def identity(self) -> dict[str, Any]:
        """Return the pattern."""
        return self.pattern.identity()


@dataclass(frozen=True, eq=False)
class AddRows(Task):
    """Add the rows that a sensor with few of them lacks."""

    scans_sensor: SensorModel
    verb: ClassVar[str] = "upsample"
    progress: ClassVar[str] = "upsampling"

    def reader(self, sensor: SensorModel, variant: ProjectionVariant) -> ScanReader:
        """Return one that knows both sensors."""
        return SparseReader(sensor, variant, source=self.scans_sensor)

    def grid(self, scan: Scan, model: SensorModel) -> RayGrid:
        """Return the rays of the dense sensor, in the columns of the scan's."""
        fine = self.scans_sensor.width * self.scans_sensor.column_stride
        return RayGrid.fitting(model, fine, self.scans_sensor.first_edge_rad)

    def condition(self, seen: InputScan, seed: int) -> Observed:
        """Return all rays of the rows that the scan has, with a return or without."""
        rows, phases = observed_rows(seen), seen.rays.phases
        masks = torch.stack([rows[:, at::phases] for at in range(phases)])
        return Observed.of_pixels(seen.rays.images(seen.image), masks)

    def result(self, seen: InputScan, condition: Observed, images: RangeImage) -> CompletedScan:
        """Return all measured points with those of the added rows."""
        return filled_scan(seen, condition, images, hides=False)

    def sensor_of_points(self, seen: InputScan) -> SensorModel:
        """Return the dense rows, with those of the scans' sensor that look above or below them all."""
        dense, own = seen.rays.sensor, self.scans_sensor
        elevation_rad, own_rad = dense.elevation_rad.mean(1), own.elevation_rad.mean(1)
        step_rad = float(-elevation_rad.diff().mean())
        beyond = (own_rad > elevation_rad[0] + step_rad / 2) | (own_rad < elevation_rad[-1] - step_rad / 2)
        rows_rad = torch.cat((elevation_rad, own_rad[beyond])).sort(descending=True).values[:, None]
        rows = {"elevation_rad": rows_rad, "azimuth_offset_rad": None}
        return replace(dense, name=f"{own.name}_upsampled", projection="spherical", **rows)

    def identity(self) -> dict[str, Any]:
        """Return the sensor of the scans."""
        return {"scans_sensor": self.scans_sensor.to_json()}


@dataclass(frozen=True)
class Drop(Task):
    """Drop the returns of clean scans, such as a simulator's, that the model's sensor would not get."""

    verb: ClassVar[str] = "raydrop"
    progress: ClassVar[str] = "dropping returns"
    kind: ClassVar[ConditionKind] = "surfaces"
    adds: ClassVar[bool] = False

    def reader(self, sensor: SensorModel, variant: ProjectionVariant) -> ScanReader:
        """Return one of whole scans."""
        cure = f"render clean scans with its rows, or train a network for yours: {_TRAIN_RAYDROP}"
        return ScanReader(sensor, variant, few_rings_cure=cure)

    def condition(self, seen: InputScan, seed: int) -> Observed:
        """Return the ranges of all surfaces."""
        return Observed.of_surfaces(seen.rays.images(seen.image))

    def result(self, seen: InputScan, condition: Observed, images: RangeImage) -> CompletedScan:
        """Return the points that return."""
        return dropped_scan(seen, condition, images)


def complete_scan(scan: Scan, model: Model, task: Task | None = None, seed: int = 0) -> CompletedScan:
    """Complete one scan, add rows to it, or drop returns of it, by each image of the model that it consists of.

    Args:
        scan: points in the sensor's frame.
        model: model or classical method; see :func:`lidargrit.inference.complete.open_model`.
        task: the work on it; every ray without a point is filled in if not given.

    Returns:
        measured points bit for bit and in their order, and those that were added;
        :meth:`CompletedScan.whole` gives them as one scan.

    Example:
        >>> import lidargrit
        >>> from lidargrit.inference.complete import open_model
        >>> scan = lidargrit.simulate(seed=0)
        >>> model = open_model("nearest", sensor=lidargrit.load_sensor("hdl64e_kitti_odometry"))
        >>> whole = complete_scan(scan, model).whole()
        >>> bool((whole.points_xyz_m[: len(scan)] == scan.points_xyz_m).all())
        True
    """
    check_seeds([seed])
    task = task or Fill(Pattern("returns"))
    seen = task.see(scan, model)
    for doubt in untold([seen.doubt] if seen.doubt else [], _doubted):
        warnings.warn(doubt, stacklevel=3)  # at whoever called the function of the Python API
    seeds = seen.rays.seeds(seed)
    condition = seen.rays.beside_one_another(task.condition(seen, derive_seed(seed)), seeds)
    return task.result(seen, condition, complete_images(model, condition, seeds))


def complete_images(model: Model, condition: Observed, seeds: list[int]) -> RangeImage:
    """Return what a model makes of images; one of which no range is known stays without a return."""
    known = condition.range_observed.flatten(1).any(1)
    if bool(known.all()):
        return model.complete(condition, seeds)
    if not bool(known.any()):
        return condition.images
    some = known.nonzero()[:, 0].tolist()
    done = model.complete(condition[some], [seeds[at] for at in some])
    place = torch.zeros(len(known), dtype=torch.int64)
    place[known] = torch.arange(len(some))
    found = done[place.tolist()]
    returned = found.return_mask & known[:, None, None]
    return RangeImage.masked(found.range_m, returned, found.sensor, found.planes)

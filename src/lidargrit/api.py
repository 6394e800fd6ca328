"""What ``import lidargrit`` offers, in one place."""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TypeAlias

import numpy as np
from torch import Tensor

from lidargrit.core.errors import ConfigError, DataError, ScanError
from lidargrit.data import formats
from lidargrit.data.datasets.kitti_odometry import KittiOdometry
from lidargrit.data.formats import BadPoints
from lidargrit.data.run_folder import PACKAGED
from lidargrit.data.sources import Source, open_source
from lidargrit.data.sources.memory import ImagesInMemory, MemorySource
from lidargrit.data.sources.scan_sensor import other_sensor
from lidargrit.data.torch_dataset import TorchDataset
from lidargrit.evaluation.evaluate import EvalConfig, evaluate_pair, open_pair, open_reference
from lidargrit.evaluation.scorecard import Scorecard
from lidargrit.generation.generator import Generator, load
from lidargrit.inference.complete import Model, open_model
from lidargrit.inference.complete.cloud import CompletedScan
from lidargrit.inference.complete.tasks import AddRows, Drop, complete_scan
from lidargrit.inference.segment import open_segmenter
from lidargrit.inference.segment.points import PointLabels
from lidargrit.scans.condition import ConditionKind, Observed
from lidargrit.scans.projection import inspect as inspect_scan
from lidargrit.scans.projection import project as project_scan
from lidargrit.scans.projection import unproject
from lidargrit.scans.projection.image import ProjectionVariant
from lidargrit.scans.projection.inspection import Inspection
from lidargrit.scans.sensors import ProjectionName, Sensor, SensorModel, load_sensor
from lidargrit.scans.types import RangeImage, Scan
from lidargrit.simulator import simulate
from lidargrit.systems.segmenter.system import Segmenter

__all__ = [
    "Observed",
    "Scan",
    "complete",
    "evaluate",
    "inspect",
    "load",
    "load_scan",
    "load_sensor",
    "open_model",
    "project",
    "raydrop",
    "segment",
    "simulate",
    "torch_dataset",
    "unproject",
    "upsample",
]

Points: TypeAlias = Scan | np.ndarray | Tensor
"""A scan, or coordinates of its points in metres as an array (n, 3), or (n, 4) with intensity."""
Scans: TypeAlias = str | Path | Sequence[Points] | RangeImage
"""A source of scans by its name or folder, scans in memory, or a batch of range images (B, H, W)."""
_packaged_model, _packaged_segmenter = lru_cache(open_model), lru_cache(open_segmenter)  # each is read once


def load_scan(path: str | Path, index: int = 0, bad_points: BadPoints = "refuse") -> Scan:
    """Read one scan from a file of any known format (``lidargrit list formats``), found from its name and content.

    Args:
        path: path of the file.
        index: index of the scan in a file that holds several.
        bad_points: treatment of bad points; ``refuse`` raises an error, ``drop`` removes points with NaN or infinite
            coordinates and points at the origin.

    Raises:
        ScanError: the file cannot be used; says what is wrong and what to do.
    """
    return formats.read_scan(path, index, bad_points)


def project(
    points: Points,
    sensor: Sensor,
    method: ProjectionName | None = None,
    variant: ProjectionVariant = "exact",
    partial: bool = False,
) -> RangeImage:
    """Return the range image of a scan: each point in the pixel whose ray it lies on, the nearest first.

    Args:
        points: scan, or its points as an array (n, 3) or (n, 4) in metres.
        sensor: sensor with the rays of the image, its name (``lidargrit list sensors``) or its file.
        method, variant, partial: settings of :func:`lidargrit.scans.projection.project`.
    """
    return project_scan(_as_scan(points), load_sensor(sensor), method, variant, partial)


def inspect(
    points: Points, sensor: Sensor, method: ProjectionName | None = None, variant: ProjectionVariant = "exact"
) -> Inspection:
    """Find what becomes of every point of a scan in its range image, and say what does not fit.

    Args:
        points: scan, or its points as an array (n, 3) or (n, 4) in metres.
        sensor, method, variant: arguments of :func:`project`.
    """
    return inspect_scan(_as_scan(points), load_sensor(sensor), method, variant)


def complete(
    points: Points, model: str | Path | Model = "pretrained", seed: int = 0, sensor: Sensor | None = None
) -> CompletedScan:
    """Fill in every ray of a scan that has no point, and keep all points as they are.

    Args:
        points: scan, or its points as an array (n, 3) or (n, 4) in metres.
        model: run that completes scans, or what :func:`open_model` returned; open a run once for many scans.
        seed: seed of what is sampled.
        sensor: sensor of the scan, for a classical method (``model="nearest"``); a run has its own.

    Returns:
        the points that stay and those that were added; ``whole()`` gives one scan whose ``filled`` marks the added.

    Raises:
        ScanError: points that cannot be used, or of another sensor than the model's.

    Example::

        whole = lidargrit.complete(points).whole()
        whole.points_xyz_m[~whole.filled]  # the measured points, bit for bit
    """
    own = None if sensor is None else load_sensor(sensor)
    return complete_scan(_as_scan(points), _opened(model, "pixels", own), None, seed)


def upsample(points: Points, sensor: Sensor, model: str | Path | Model = "pretrained", seed: int = 0) -> CompletedScan:
    """Add the rows that a sensor with few of them lacks, and keep all points as they are.

    Args:
        points: scan, or its points as an array (n, 3) or (n, 4) in metres.
        sensor: sensor that made the scan, its name, such as ``vlp16``, or its file.
        model, seed: arguments of :func:`complete`; the model has the rows that are added.
    """
    return complete_scan(_as_scan(points), _opened(model, "pixels"), AddRows(load_sensor(sensor)), seed)


def raydrop(points: Points, model: str | Path | Model = "pretrained", seed: int = 0) -> CompletedScan:
    """Drop returns of a clean scan, such as a simulator's, that a real sensor would not get.

    Args:
        points: scan, or its points as an array (n, 3) or (n, 4) in metres.
        model, seed: arguments of :func:`complete`.

    Returns:
        the scan; ``kept`` is True for each point that returns, ``whole()`` has these alone.

    Example::

        kept = lidargrit.raydrop(points).kept.numpy()
    """
    return complete_scan(_as_scan(points), _opened(model, "surfaces"), Drop(), seed)


def segment(points: Points, model: str | Path | Segmenter = "pretrained") -> Scan:
    """Label every point of a scan with its class, by SemanticKITTI's numbers.

    Args:
        points: scan, or its points as an array (n, 3), or (n, 4) with intensity, in metres.
        model: run of a segmenter, or what :func:`load` returned for it (``load("pretrained", "segment")``); load a run
            once for many scans.

    Returns:
        the scan with all its points, in their order, and their labels; 0 for points without a return of the range image
        nearby.

    Raises:
        ScanError: points that cannot be used, or of another sensor than the segmenter's.

    Example::

        is_car = lidargrit.segment(points).label == 10
    """
    scan = _as_scan(points)
    if isinstance(model, Generator) and not isinstance(model, Segmenter):
        raise _other_model(model, 'lidargrit.load(NAME, "segment")')
    segmenter = _packaged_segmenter(PACKAGED[0].name) if model == PACKAGED[0].name else model
    labels = PointLabels(segmenter if isinstance(segmenter, Segmenter) else open_segmenter(str(segmenter)))
    return replace(scan, label=labels.of(scan)[0])


def evaluate(
    generated: Scans,
    reference: Scans,
    protocol: str = "exact",
    metrics: Sequence[str] = (),
    max_scans: int = 0,
    sensor: Sensor = KittiOdometry.sensor,
) -> Scorecard:
    """Score a folder of samples, or any scans, against others.

    Args:
        generated: a folder of samples, of ours or of another program, a source of scans, scans in memory, or range
            images in memory, such as what :meth:`Generator.sample` returned.
        reference: a set to compare with, of the same kinds; its scans are projected with the sensor of ``generated``.
            Or a reference file (``evaluate DATA --save-reference``).
        protocol: name of the protocol, which chooses and defines the metrics (``lidargrit list protocols``).
        metrics: names of metrics, instead of the protocol's.
        max_scans: largest number of scans of each set; 0 for the protocol's.
        sensor: sensor of scans in memory, its name or its file; range images have theirs.

    Returns:
        scores with intervals, beside those of real scans against real scans: ``card.scores``, or
        ``print(card.as_table())`` for all of them.
    """
    settings = EvalConfig(protocol=protocol, metrics=tuple(metrics), max_scans=max_scans)
    named, own = isinstance(reference, (str, Path)), load_sensor(sensor)
    real = open_reference(str(reference), settings) if named else _source(reference, own)
    return evaluate_pair(open_pair(_source(generated, own), real, settings), settings)


def _as_scan(points: Points) -> Scan:
    if isinstance(points, Scan):
        return points
    if isinstance(points, (np.ndarray, Tensor)):
        return Scan.from_points(points)
    wanted = "a Scan, or its points as a NumPy array or torch tensor"
    cure = "np.asarray(points), or lidargrit.load_scan(path)"
    if isinstance(points, RangeImage):
        cure = "take its points: lidargrit.unproject(image)"
    raise ScanError(f"points as {type(points).__name__}", wanted, cure)


def _source(scans: Scans, sensor: SensorModel) -> Source:
    if isinstance(scans, (str, Path)):
        return open_source(str(scans))
    if isinstance(scans, RangeImage):
        return ImagesInMemory(scans)
    if isinstance(scans, Scan):
        raise DataError("a single scan in place of a set", "several scans", "give them as a list")
    return MemorySource([_as_scan(points) for points in scans], sensor)


def _other_model(model: object, cure: str) -> ConfigError:
    return ConfigError(f"a {type(model).__name__} as the model", "a run's name or folder, or an opened model", cure)


def _opened(model: str | Path | Model, kind: ConditionKind, sensor: SensorModel | None = None) -> Model:
    if isinstance(model, Model):
        if sensor is not None and not model.sensor.same_rays(sensor):
            raise other_sensor(sensor, model.sensor, model.name)
        return model
    if not isinstance(model, (str, Path)):
        raise _other_model(model, "lidargrit.open_model(NAME)")
    packaged = str(model) in {folder.name for folder in PACKAGED}
    return _packaged_model(model, kind) if packaged and sensor is None else open_model(model, kind, sensor)


def torch_dataset(source: str | Path, sensor: Sensor | None = None) -> TorchDataset:
    """Return the range images of a source as a data set for torch's loaders.

    Args:
        source: samples, prepared scans, a data set, a folder, or "simulated:COUNT".
        sensor: sensor that scans are projected with; the source's own if not given.

    Example:
        >>> dataset = torch_dataset("simulated:2", load_sensor("hdl64e_kitti_odometry").with_columns(64))
        >>> dataset[1]["range_m"].shape
        torch.Size([64, 64])
    """
    return TorchDataset(str(source), None if sensor is None else load_sensor(sensor))

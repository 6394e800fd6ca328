"""What ``import lidargrit`` offers, in one place."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lidargrit.datasets import BadPoints
from lidargrit.datasets._files import read_bin
from lidargrit.evaluation import score
from lidargrit.generators import load
from lidargrit.loading import DataConfig
from lidargrit.projection import project, unproject
from lidargrit.sensors import load_sensor
from lidargrit.simulator import simulate
from lidargrit.structures import MetricResult, Scan

__all__ = ["evaluate", "load", "load_scan", "load_sensor", "project", "simulate", "unproject"]


def load_scan(path: str | Path, bad_points: BadPoints = "refuse") -> Scan:
    """Read one scan from a KITTI-style ``.bin`` file: float32 rows of x, y, z in metres and reflectance.

    Args:
        path: of the file.
        bad_points: ``drop`` removes points with NaN or infinite coordinates and points at the origin.

    Raises:
        ScanError: the file cannot be used; says what is wrong and what to do.
    """
    return read_bin(Path(path), bad_points)


def evaluate(
    generated: str, reference: str, metrics: Sequence[str] = ("sliced_wasserstein",), max_scans: int = 0
) -> list[MetricResult]:
    """Score a folder of samples, or any source of scans, against another.

    Args:
        generated: a folder that ``lidargrit sample`` wrote, or a source of scans.
        reference: likewise; scans are projected with the sensor of ``generated``.
        metrics: names, each computed in all its variants.
        max_scans: of each; 0 for all.
    """
    config = DataConfig(max_scans=max_scans)
    samples = score.open_images(generated, None, config)
    return score.evaluate(samples, score.open_images(reference, samples.sensor, config), metrics)

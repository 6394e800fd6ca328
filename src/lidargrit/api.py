"""What ``import lidargrit`` offers, in one place."""

from collections.abc import Sequence
from pathlib import Path

from lidargrit.data import formats
from lidargrit.data.formats import BadPoints
from lidargrit.evaluation.comparison import EvalConfig, compare_sources
from lidargrit.evaluation.scorecard import Scorecard
from lidargrit.generation.generator import load
from lidargrit.scans.condition import Observed
from lidargrit.scans.projection import inspect, project, unproject
from lidargrit.scans.sensors import load_sensor
from lidargrit.scans.types import Scan
from lidargrit.simulator import simulate

__all__ = ["Observed", "evaluate", "inspect", "load", "load_scan", "load_sensor", "project", "simulate", "unproject"]


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


def evaluate(
    generated: str, reference: str, protocol: str = "exact", metrics: Sequence[str] = (), max_scans: int = 0
) -> Scorecard:
    """Score a folder of samples, or any source of scans, against another.

    Args:
        generated: a folder of samples, of ours or of another program, or a source of scans.
        reference: a set to compare with, of the same kinds; its scans are projected with the sensor of ``generated``.
        protocol: name of the protocol, which chooses and defines the metrics (``lidargrit list protocols``).
        metrics: names of metrics, instead of the protocol's.
        max_scans: largest number of scans of each set; 0 for the protocol's.

    Returns:
        scores with intervals, beside those of real scans against real scans: ``card.scores``, or
        ``print(card.as_table())`` for all of them.
    """
    settings = EvalConfig(protocol=protocol, metrics=tuple(metrics), max_scans=max_scans)
    return compare_sources(generated, reference, settings)[0]

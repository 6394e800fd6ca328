"""Who is compared with whom, how, on how many scans: name → :class:`Protocol`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from lidargrit import _discovery
from lidargrit.errors import UnknownNameError, nearest_names
from lidargrit.projection import Variant
from lidargrit.sensors import SensorModel, load_sensor

DEFAULT = "exact"


@dataclass(frozen=True)
class MetricChoice:
    """One number that a protocol asks for.

    Args:
        metric: its name.
        variant: its definition; each that the metric has if empty.
        options: keyword options of the metric besides variant and seed.
    """

    metric: str
    variant: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Protocol:
    """Everything that has to be equal before two figures of one name may be compared.

    Args:
        title: one line.
        source: whose it is: a paper, or a program and its commit.
        metrics: numbers that it asks for, in the order of its table.
        sensor: whose rays the images have; that of the samples or the scans if empty.
        columns: fine columns of the circle; 0 for the sensor's own.
        column_stride: every n-th of them is kept.
        variant: of the projection of real scans.
        range_m: a return that is not strictly between these is none, in both sets; None for the sensor's own limits.
        num_scans: of each set; 0 for as many as there are.
        data_set: which data set the reference is of; any if empty.
        splits: by which names of a split the reference may be called; any if empty.
        departures: what we do otherwise than the source, and what it changes.
    """

    title: str
    source: str
    metrics: tuple[MetricChoice, ...]
    sensor: str = ""
    columns: int = 0
    column_stride: int = 1
    variant: Variant = "exact"
    range_m: tuple[float, float] | None = None
    num_scans: int = 0
    data_set: str = ""
    splits: tuple[str, ...] = ()
    departures: tuple[str, ...] = ()

    def load_sensor(self) -> SensorModel | None:
        """Return the sensor whose rays the images should have; None if any will do."""
        if not self.sensor:
            return None
        sensor = load_sensor(self.sensor)
        return sensor.with_columns(self.columns, self.column_stride) if self.columns else sensor


def load_protocol(name: str) -> Protocol:
    """Return a protocol by its name, with "-" or "_".

    Raises:
        UnknownNameError: no such protocol; names its nearest neighbours.

    Example:
        >>> load_protocol("lidargrit-kitti-360").num_scans
        5000
    """
    name, known = public_name(name), _discovery.names("evaluation.protocols")
    if name not in known:
        raise UnknownNameError(f"the protocol {name!r}", f"one of {nearest_names(name, known, 6)}", "choose one")
    return _discovery.load_instance("evaluation.protocols", name, Protocol)


def public_name(name: str) -> str:
    """Return the name of a file for what a user types."""
    return name.strip().lower().replace("-", "_")

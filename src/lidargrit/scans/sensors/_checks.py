"""Azimuths of columns, and checks of a sensor's tables and limits, from code or from an untrusted JSON file."""

import math
from collections.abc import Sequence
from typing import Annotated, Any

import torch
from jaxtyping import Float
from torch import Tensor

from lidargrit.core.errors import ConfigError, nearest_names
from lidargrit.core.typed_values import Bounds, fits, in_words


def column_azimuths_rad(columns: int, stride: int = 1, first_edge_rad: float = math.pi) -> Float[Tensor, "1 W"]:
    """Return the azimuths of the centres of every ``stride``-th of ``columns`` equal columns, from +pi down to -pi.

    Args:
        columns: number of columns around the circle.
        stride: number of columns of which one is taken.
        first_edge_rad: azimuth at which the first column begins.
    """
    index = torch.arange(0, columns, stride, dtype=torch.float64)
    return (first_edge_rad - 2 * math.pi * (index + 0.5) / columns).float()[None]


def mean_azimuths_rad(azimuth_rad: Float[Tensor, "H W"]) -> Float[Tensor, " W"]:
    """Return the mean azimuth of every column around the circle, in 64 bits, from -pi to +pi."""
    table = azimuth_rad.double()
    return torch.atan2(table.sin().mean(dim=0), table.cos().mean(dim=0))


def continuous_azimuths_rad(azimuth_rad: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Return azimuths without a jump of a full turn from one column or row to the next, in 64 bits."""
    of_columns = mean_azimuths_rad(azimuth_rad)
    turns = ((of_columns.diff(prepend=of_columns[:1]) + math.pi) / (2 * math.pi)).floor().cumsum(0)
    of_columns = of_columns - 2 * math.pi * turns
    aside = azimuth_rad.double() - of_columns
    return of_columns + torch.atan2(aside.sin(), aside.cos())


_Number = Annotated[float, Bounds(-1e9, 1e9)]  # anything larger is no number of a sensor
_VALUES: dict[str, Any] = {
    **dict.fromkeys(("name", "source", "projection"), str),
    **dict.fromkeys(("range_min_m", "range_max_m", "first_edge_rad"), _Number),
    "column_stride": int,
}
_TABLES = {"elevation_rad": 2, "azimuth_rad": 2, "azimuth_offset_rad": 1}  # with their dimensions
_MAY_BE_LEFT_OUT = {"source", "column_stride", "azimuth_offset_rad", "first_edge_rad"}
_ROWS_AT_MOST = 4096  # sensors have up to 256 lasers; a table beyond this is a mistake that would fill the memory
FINE_COLUMNS_AT_MOST = 65536  # sensors fire up to 4096 times a revolution
# 128 rows of 4096 columns have a thirtieth; images of a stranger's sensor would fill the memory.
_PIXELS_AT_MOST = 2**24
_APART_AT_MOST = 0.75  # of a column: published programs take the edges of columns, half a column from the centres
_EDGE_ASIDE_AT_MOST_RAD = math.radians(1)
_MEASURED_APART_AT_MOST_RAD = math.radians(5)
NAME_AT_MOST = 200  # letters: a name is part of messages
_CURE = "compare it with what SensorModel.to_json writes"


def check_tables(
    name: str,
    elevation: Tensor,
    azimuth: Tensor,
    offset: Tensor | None,
    column_stride: int,
    first_edge_rad: float = math.pi,
) -> None:
    """Check the shapes, the sizes and the angles of a sensor's tables, in radians."""
    if not (
        elevation.ndim == azimuth.ndim == 2
        and len(azimuth) in (1, len(elevation))
        and elevation.shape[1] in (1, azimuth.shape[1])
    ):
        raise ConfigError(
            f"elevations of shape {tuple(elevation.shape)} and azimuths of {tuple(azimuth.shape)} for {name!r}",
            "(H, 1) and (1, W), or (H, W)",
            "put each elevation into a row of its own and all azimuths into one row",
        )
    height, width = len(elevation), azimuth.shape[1]
    columns = width * column_stride
    fits = 1 <= height <= _ROWS_AT_MOST and column_stride >= 1 <= columns <= FINE_COLUMNS_AT_MOST
    if not fits or height * columns > _PIXELS_AT_MOST:
        raise ConfigError(
            f"{height} rows, {width} columns and one in {column_stride} kept for {name!r}",
            f"1 to {_ROWS_AT_MOST} rows, 1 to {FINE_COLUMNS_AT_MOST} columns before any is left out, and at most "
            f"{_PIXELS_AT_MOST:,} pixels",
            "correct the sensor's tables",
        )
    if offset is not None and offset.shape != (height,):
        raise ConfigError(
            f"azimuth_offset_rad of shape {tuple(offset.shape)} for the sensor {name!r}",
            f"one number for each of its {height} rows",
            "give as many offsets as rows, or leave them out",
        )
    _check_angles(name, "elevation_rad", elevation, math.pi / 2)
    _check_angles(name, "azimuth_rad", azimuth, 2 * math.pi)
    if offset is not None:
        _check_angles(name, "azimuth_offset_rad", offset, math.pi)
    if not bool((elevation.diff(dim=0) < 0).all()):
        raise ConfigError(
            f"elevations of the sensor {name!r} that do not fall from row to row",
            "row 0 the highest ray, every next row lower",
            "sort the rows of the sensor",
        )
    if not abs(first_edge_rad - math.pi) <= max(2 * math.pi / columns, _EDGE_ASIDE_AT_MOST_RAD):
        raise ConfigError(
            f"first_edge_rad={first_edge_rad:g} of the sensor {name!r}",
            f"+pi, or at most a degree or the width of one of {columns} columns beside it",
            "correct it, or leave it out",
        )
    _check_columns(name, azimuth, column_stride, first_edge_rad)


def _check_columns(name: str, azimuth_rad: Tensor, stride: int, first_edge_rad: float) -> None:
    """Refuse azimuths of columns other than those into which points are projected: equal ones, from +pi down.

    Azimuths of every pixel are measured ones: the mean of each column may lie somewhat further off.
    """
    columns = azimuth_rad.shape[1] * stride
    at_most_rad = _APART_AT_MOST * 2 * math.pi / columns
    if len(azimuth_rad) > 1:
        at_most_rad = max(at_most_rad, _MEASURED_APART_AT_MOST_RAD)
    centres_rad = column_azimuths_rad(columns, stride, first_edge_rad)[0].double()
    apart_rad = (mean_azimuths_rad(azimuth_rad) - centres_rad + math.pi).remainder(2 * math.pi) - math.pi
    if float(apart_rad.abs().max()) > at_most_rad:
        raise ConfigError(
            f"azimuths of the sensor {name!r} that are not those of equal columns from +pi down",
            f"the centres of {columns} columns around the circle, clockwise from behind",
            "give azimuth_rad so, as lidargrit fit-sensor does",
        )


def check_projection(name: str, projection: str, known: Sequence[str]) -> None:
    """Raise ConfigError if a sensor names a projection that there is not."""
    if projection not in known:
        what = f"the projection {projection[:40]!r} of the sensor {name!r}"
        raise ConfigError(what, " or ".join(known), "choose one of them")


def _check_angles(name: str, table: str, angles_rad: Tensor, at_most_rad: float) -> None:
    if not bool((angles_rad.abs() <= at_most_rad + 1e-6).all()):  # also refuses NaN
        raise ConfigError(
            f"{table} of the sensor {name!r} with NaN or beyond {math.degrees(at_most_rad):.0f} degrees",
            f"radians of at most {at_most_rad:.4f} in either direction",
            "correct the table; if it is in degrees, multiply by pi / 180",
        )


def checked_entries(data: Any, projections: Sequence[str]) -> dict[str, Any]:
    """Return the entries of a sensor's JSON, its tables as tensors and its metres as floats."""
    if not isinstance(data, dict):
        raise ConfigError(f"a {type(data).__name__} instead of a sensor", "named entries, {...}", _CURE)
    known = {*_VALUES, *_TABLES}
    if missing := sorted(known - _MAY_BE_LEFT_OUT - data.keys()):
        raise ConfigError(f"a sensor without {', '.join(missing)}", "every entry", _CURE)
    if unknown := sorted(str(key) for key in data if key not in known):
        what = f"a sensor with the entry {unknown[0][:40]!r}"
        raise ConfigError(what, f"one such as {nearest_names(unknown[0], known)}", _CURE)
    entries = {key: value for key, value in data.items() if not (key == "azimuth_offset_rad" and value is None)}
    checked = {key: _checked(key, value) for key, value in entries.items()}
    check_projection(checked["name"], checked["projection"], projections)
    tables = (checked["elevation_rad"], checked["azimuth_rad"], checked.get("azimuth_offset_rad"))
    check_tables(checked["name"], *tables, checked.get("column_stride", 1), checked.get("first_edge_rad", math.pi))
    return checked


def _checked(key: str, value: Any) -> Any:
    if key in _VALUES:
        if not fits(_VALUES[key], value):  # Python refuses to print a whole number of any length: so no value here
            raise ConfigError(f"no usable value for a sensor's {key}", in_words(_VALUES[key]), _CURE)
        if key == "name" and not (0 < len(value) <= NAME_AT_MOST and value.isprintable()):  # pictures show it
            what = f"{len(value)} letters{'' if value.isprintable() else ', not all of which can be printed,'}"
            raise ConfigError(f"{what} for a sensor's name", f"1 to {NAME_AT_MOST} letters in one line", _CURE)
        return float(value) if _VALUES[key] is _Number else value
    try:
        table = torch.tensor(value, dtype=torch.float32)
    except (TypeError, ValueError, RuntimeError, OverflowError):  # words among the numbers, rows of several lengths
        table = torch.empty(())
    if table.ndim != _TABLES[key] or not table.numel():
        lists = "a list of numbers" if _TABLES[key] == 1 else "a list of rows of numbers, all of one length"
        raise ConfigError(f"a sensor whose {key} is no table", lists, _CURE)
    return table

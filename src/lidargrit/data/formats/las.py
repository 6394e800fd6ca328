"""LAS files of the surveying world, uncompressed ⇄ :class:`Scan`."""

import struct
import warnings
from collections.abc import Mapping
from datetime import date
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from lidargrit.core.errors import OutputError, ScanError
from lidargrit.core.files import atomic_path
from lidargrit.data.formats import POINTS_AT_MOST, BadPoints, damaged, read_bytes
from lidargrit.data.formats.shared.columns import (
    BYTES_AT_MOST,
    ColumnFormat,
    begins_as,
    columns_of,
    little_endian,
    scan_of_columns,
)
from lidargrit.scans.types import Scan

_FORMAT = "an uncompressed LAS file of version 1.0 to 1.4"
_INSTALL = "pip install 'lidargrit[las]'"
_HEADER_BYTES = 227  # the shortest, of versions 1.0 to 1.2
_HEADER_BYTES_14 = 375
_COMPRESSED = 0xC0  # bits of the point format that LAZ sets
_POINT_FORMATS = 11  # 0 to 10
_RECORDS_AT_MOST = 1000  # of remarks between header and points; real files have 1 to 10
_TIME = "gps_time"  # in seconds
_STEP_M = 1e-4  # in which coordinates are kept: a twentieth of a sensor's own step, and 214 km in 32 bits
_OURS = "lidargrit"  # the program that writes a file
_POINT_FORMATS_WRITTEN = (0, 1, 2, 3, 6, 7, 8)  # those without wave packets, whose data are not read
_NOT_READ = (
    *("X", "Y", "Z"),  # in steps
    *("wavepacket_index", "wavepacket_offset", "wavepacket_size", "return_point_wave_location", "x_t", "y_t", "z_t"),
)
_NAME_BYTES = 32  # of an extra dimension
_EXTRAS_AT_MOST = 341  # of 192 bytes each in one record
_KINDS = [f"{kind}{size}" for kind in "ui" for size in (1, 2, 4, 8)] + ["f4", "f8"]  # of extra dimensions
_INTENSITY_STEPS = 65_535  # 16 bits, as the standard wants them
_WRITTEN_ON = date(2000, 1, 1)  # the same scan gives the same bytes on every day


class Las(ColumnFormat):
    """LAS 1.0 to 1.4; compressed files (LAZ) have to be unpacked first.

    Reflectance is LAS's intensity, and none where all of it is 0, which is how LAS says so. Files that this program
    writes have it from 0 to 1, too, in an extra dimension of that name, as they have ring and label; the classes of LAS
    are others than SemanticKITTI's, and only kept. Files are written as version 1.4 with coordinates in steps of
    0.1 mm, in the first point format that has what is known of points: 0, or 1 where they have times.

    Source:
        LAS Specification 1.4 R15, American Society for Photogrammetry and Remote Sensing, 2019.
    """

    title = "LAS (surveying)"
    suffixes = (".las",)
    extra = "las"

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether a file begins with a header of uncompressed LAS."""
        return begins_as(path, _HEADER_BYTES_14, partial(_check_header, None))

    @staticmethod
    def read(path: Path, index: int = 0, bad_points: BadPoints = "refuse") -> Scan:
        """Read the scan in a file."""
        data = read_bytes(path, BYTES_AT_MOST, _FORMAT)
        _check_header(len(data), data[:_HEADER_BYTES_14], path)
        try:
            import laspy  # noqa: PLC0415  an optional part
        except ImportError:
            raise ScanError(f"{path}, which takes laspy to read", "it installed", _INSTALL) from None
        try:
            with (
                warnings.catch_warnings(action="ignore"),  # of remarks that it cannot read, and of huge coordinates
                laspy.LasReader(BytesIO(data), read_evlrs=False) as reader,
            ):
                columns = _columns(reader.read_points(-1), reader.header.generating_software == _OURS)
        except Exception as error:  # the library meets a damaged file with whatever it stumbles over
            raise damaged(path, _FORMAT, error) from None
        return scan_of_columns(columns, path, bad_points)

    @classmethod
    def columns_of(cls, scan: Scan) -> dict[str, np.ndarray]:
        """Return coordinates, and what the scan has of intensity, ring, label, filled and gps_time."""
        columns = columns_of(scan)
        return {_TIME if name == "time" else name: values for name, values in columns.items()}

    @classmethod
    def write_columns(cls, path: Path, columns: Mapping[str, np.ndarray]) -> None:
        """Write columns to a new file; intensity of whole numbers is LAS's own, and any other is reflectance."""
        try:
            import laspy  # noqa: PLC0415  an optional part
        except ImportError:
            raise OutputError(f"no laspy to write {path}", "it installed", _INSTALL) from None
        xyz_m = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(np.float64)
        farthest_m = float(np.abs(xyz_m).max())
        if farthest_m >= _STEP_M * np.iinfo(np.int32).max:
            raise OutputError(f"a coordinate of {farthest_m:g} m", "at most 214 km", "choose .ply")
        columns = {name: values for name, values in columns.items() if name not in ("x", "y", "z")}
        intensity = columns.pop("intensity", None)
        if intensity is not None and intensity.dtype.kind == "f":  # it alone does not say what its full scale is
            columns["reflectance"], intensity = intensity.astype(np.float32), _steps(intensity)
        kinds = map(laspy.PointFormat, _POINT_FORMATS_WRITTEN)
        chosen = min(kinds, key=lambda kind: sum(not _fits(*column, kind) for column in columns.items()))
        header = laspy.LasHeader(version="1.4", point_format=chosen.id)
        header.scales, header.offsets = np.full(3, _STEP_M), np.zeros(3)
        header.generating_software, header.creation_date = _OURS, _WRITTEN_ON
        own = {name: values for name, values in columns.items() if _fits(name, values, chosen)}
        extra = {name: values for name, values in columns.items() if name not in own}
        extra = _extra_dimensions(extra, chosen, path)
        header.add_extra_dims([laspy.ExtraBytesParams(name, values.dtype) for name, values in extra.items()])
        points = laspy.ScaleAwarePointRecord.zeros(len(xyz_m), header=header)
        of_las = dict(zip("xyz", xyz_m.T, strict=True)) | ({} if intensity is None else {"intensity": intensity})
        for name, values in {**of_las, **own, **extra}.items():
            points[name] = values
        with (
            atomic_path(path) as temporary,
            temporary.open("wb") as file,
            laspy.LasWriter(file, header, do_compress=False, closefd=False) as writer,
        ):
            writer.write_points(points)


def _fits(name: str, values: np.ndarray, kind: Any) -> bool:
    """Return whether a column is a dimension of a point format, which holds all its values."""
    own = next((one for one in kind.dimensions if one.name == name and name not in _NOT_READ), None)
    if own is None or name == _TIME:
        return own is not None
    return values.dtype.kind in "iu" and own.min <= values.min(initial=0) and values.max(initial=0) <= own.max


def _extra_dimensions(columns: Mapping[str, np.ndarray], kind: Any, path: Path) -> dict[str, np.ndarray]:
    """Return columns in types and by names that extra dimensions of a point format can have."""
    if len(columns) > _EXTRAS_AT_MOST:
        got = f"{len(columns)} columns besides those of LAS for {path}"
        raise OutputError(got, f"at most {_EXTRAS_AT_MOST}", "choose .ply")
    taken, renamed = {"", *kind.dtype().names, *kind.dimension_names}, dict[str, np.ndarray]()
    for name, values in columns.items():
        number, short = 1, name.encode()[:_NAME_BYTES].decode(errors="ignore")
        while short in taken:
            number += 1
            end = f"_{number}"
            short = name.encode()[: _NAME_BYTES - len(end)].decode(errors="ignore") + end
        taken.add(short)
        renamed[short] = little_endian(values, _KINDS)
    return renamed


def _columns(points: Any, ours: bool) -> dict[str, np.ndarray]:
    """Return coordinates and all else that is known of points: what LAS has no values of is 0 for all."""
    columns = {axis: np.asarray(points[axis], dtype=np.float64) for axis in "xyz"}
    of_las, intensity = {*points.point_format.standard_dimension_names}, np.asarray(points["intensity"])
    for name in points.point_format.dimension_names:
        values = np.asarray(points[name])
        is_known = name not in of_las or name == _TIME or values.any()
        if name not in _NOT_READ and values.ndim == 1 and is_known:
            columns[name] = values
    if ours and "reflectance" in columns:
        off = np.abs(intensity - _steps(columns["reflectance"]).astype(np.int64))
        if np.any(off > 1):  # by which points that were added to a file may be rounded
            del columns["reflectance"]  # of before another program changed the intensity
    return columns


def _steps(reflectance: np.ndarray) -> np.ndarray:
    """Return the intensity that is written for reflectance from 0 to 1."""
    return (_INTENSITY_STEPS * reflectance.astype(np.float64).clip(0, 1)).round().astype(np.uint16)


def _check_header(size: int | None, header: bytes, path: Path) -> None:
    """Refuse a header that asks for more than the file has; a size of None is not known yet."""
    if len(header) < _HEADER_BYTES or header[:4] != b"LASF" or header[24] != 1 or header[25] > 4:
        raise ScanError(f"{path}, which is no LAS file", _FORMAT, "convert it, or download it again")
    start, records, kind, row_bytes, points = struct.unpack_from("<IIBHI", header, 96)
    if header[25] == 4 and len(header) >= _HEADER_BYTES_14:
        points = struct.unpack_from("<Q", header, 247)[0]
    if kind & _COMPRESSED:
        raise _refused("compressed points (LAZ)", path, "unpack it, for instance with: laszip")
    if kind >= _POINT_FORMATS or records > _RECORDS_AT_MOST:
        raise _refused(f"points of format {kind} after {records} records", path)
    if not 0 < points <= POINTS_AT_MOST or (size is not None and start + points * row_bytes > size):
        raise _refused(f"{points} points of {row_bytes} bytes{'' if size is None else f' in {size} bytes'}", path)


def _refused(what: str, path: Path, cure: str = "download it again, or convert it") -> ScanError:
    return ScanError(f"{path}, a LAS file of {what}", _FORMAT, cure)

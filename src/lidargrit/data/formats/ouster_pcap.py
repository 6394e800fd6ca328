"""Ouster .pcap with its .json of the same name: packets of any Ouster sensor → :class:`Scan` with a ring per point."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lidargrit.core.errors import ScanError, first_words
from lidargrit.core.files import read_json, remembered
from lidargrit.data.formats import BadPoints, ScanFormat, first_bytes, open_file, scan_of
from lidargrit.data.formats.shared.packets import PCAP, PCAPNG, check_packets, other_maker
from lidargrit.scans.sensors import SensorModel, column_azimuths_rad, load_sensor
from lidargrit.scans.types import Scan

_METADATA_BYTES_AT_MOST = 10_000_000  # 128 beams take 10 kB
_BEAMS_AT_MOST, _COLUMNS_AT_MOST = 512, 8192  # sensors have up to 128 beams and 4096 columns
_FORMAT = "a recording of packets, with the sensor's metadata beside it as a .json of the same name"
_CURE = "record it again with: ouster-cli source SENSOR save NAME.pcap"
_WIDEST_LIMITS_M = (0.3, 300.0)  # of all Ouster sensors, for those that we have no model of


class OusterPcap(ScanFormat):
    """Recordings of one Ouster sensor: one scan for each revolution, the first return of each beam.

    The origin is where the beams cross the sensor's axis, not its base, so that elevations are those of the metadata;
    ``sensor_of`` makes a sensor of them. The first and the last revolution may be incomplete.

    Source:
        Ouster's software development kit (ouster-lidar/ouster-sdk), which unpacks the packets.
    """

    title = "Ouster .pcap with its .json"
    suffixes = (".pcap",)
    reflectance = "calibrated reflectivity of 8 bits, divided by 255"
    frame = "x forward (away from the plug), y left, z up, origin at the sensor's base"
    several = True
    companion = "the sensor's metadata, a .json of the same name"
    extra = "ouster"

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether a file begins as a recording of packets."""
        return first_bytes(path, 4) in (*PCAP, PCAPNG)

    @staticmethod
    def count(path: Path) -> int:
        """Count the revolutions in a recording; reads all of it once."""
        return len(_open(path)[0])

    @staticmethod
    def read(path: Path, index: int = 0, bad_points: BadPoints = "refuse") -> Scan:
        """Read one revolution."""
        source, points_of, height_m, row_to_ring = _open(path)
        try:
            frame = source[index][0]
            range_mm = frame.field("RANGE")
            returned = range_mm > 0
            xyz_m = points_of(frame)[returned] - (0, 0, height_m)
            reflectivity = frame.field("REFLECTIVITY") if "REFLECTIVITY" in list(frame.fields) else None
        except Exception as error:  # the library meets damaged packets with whatever it stumbles over
            raise _unusable(path, error) from None
        reflectance = None
        if reflectivity is not None:
            # 8 bits in every profile, that of the oldest recordings included
            reflectance = torch.from_numpy((reflectivity[returned] / 255).astype(np.float32))
        ring = torch.from_numpy(row_to_ring[np.nonzero(returned)[0]])
        with np.errstate(over="ignore"):  # infinite, and so refused or dropped
            points_xyz_m = torch.from_numpy(xyz_m.astype(np.float32))
        fired_s = torch.from_numpy(frame.timestamp[np.nonzero(returned)[1]].astype(np.float64) / 1e9)
        return scan_of(points_xyz_m, reflectance, ring, f"{path}#{index}", bad_points, point_time_s=fired_s)

    @staticmethod
    def sidecar_files(path: Path) -> tuple[Path, ...]:
        """Return the file of the sensor's metadata."""
        return (path.with_suffix(".json"),)


def sensor_of(path: Path) -> SensorModel:
    """Make a sensor of an Ouster's metadata: its beams' own elevations and azimuths; needs no Ouster software.

    Args:
        path: the .json, or the .pcap beside it.

    Source:
        Ouster's metadata: beam_altitude_angles and beam_azimuth_angles in degrees, the latter clockwise. Limits are
        those of our model of the same line, if there is one, and else the widest of any Ouster sensor.
    """
    metadata = _metadata_of(path) if path.suffix.lower() == ".pcap" else path
    data = _read_json(metadata)
    beams = {**data, **_section(data, "beam_intrinsics")}
    layout = {**_section(data, "data_format"), **_section(data, "lidar_data_format")}
    line = str({**data, **_section(data, "sensor_info")}.get("prod_line", "OS-1"))[:20]
    try:
        altitude_deg = np.asarray(beams["beam_altitude_angles"], dtype=np.float64)
        azimuth_deg = np.asarray(beams["beam_azimuth_angles"], dtype=np.float64)
        mode = {**data, **_section(data, "config_params")}.get("lidar_mode")
        in_mode = str(mode).partition("x")[0] if mode else 1024  # 2048x10 has 2,048 columns, ten times a second
        columns = int(layout.get("columns_per_frame", in_mode))
        if altitude_deg.shape != azimuth_deg.shape or not (1 <= altitude_deg.size <= _BEAMS_AT_MOST):
            raise ValueError(f"{altitude_deg.shape} altitudes, {azimuth_deg.shape} azimuths")
        if not 1 <= columns <= _COLUMNS_AT_MOST:
            raise ValueError(f"{columns} columns")
        order = (-altitude_deg).argsort(kind="stable")
        first_edge_rad = math.pi + math.pi / columns  # it fires at whole multiples of a column
        model = load_sensor("os1_128")
        known = line.startswith("OS-1")
        near_m, far_m = (model.range_min_m, model.range_max_m) if known else _WIDEST_LIMITS_M
        return SensorModel(
            name=metadata.stem,
            elevation_rad=torch.from_numpy(np.radians(altitude_deg[order])).float()[:, None],
            azimuth_rad=column_azimuths_rad(columns, first_edge_rad=first_edge_rad),
            range_min_m=near_m,
            range_max_m=far_m,
            projection="spherical",
            source=f"metadata of a sensor of the line {line}, {metadata.name}",
            azimuth_offset_rad=torch.from_numpy(-np.radians(azimuth_deg[order])).float(),
            first_edge_rad=first_edge_rad,
        )
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        got = f"{metadata}, which is no metadata of an Ouster sensor ({first_words(error)})"
        raise ScanError(got, _FORMAT, _CURE) from None


@remembered(lambda path: [path, path.with_suffix(".json")], at_most=2)
def _open(path: Path) -> tuple[Any, Any, float, np.ndarray]:
    """Return the revolutions of a recording, what turns one into points, and the height of the beams over the base."""
    open_file(path, _FORMAT).close()
    metadata = _metadata_of(path)
    if not OusterPcap.recognises(path):
        raise ScanError(f"{path}, which is no recording of packets", _FORMAT, _CURE)
    text = json.dumps(_read_json(metadata))
    try:
        from ouster.sdk.core import SensorInfo, XYZLut  # noqa: PLC0415  # pyright: ignore[reportPrivateImportUsage]
        from ouster.sdk.pcap import PcapFrameSetSource  # noqa: PLC0415  # pyright: ignore[reportPrivateImportUsage]
    except ImportError:
        cure = "pip install 'lidargrit[ouster]'"
        raise ScanError(f"{path}, which takes ouster-sdk (1.0 or later) to read", "it installed", cure) from None
    try:
        info = SensorInfo(text)
        layout = info.format
        if layout.pixels_per_column > _BEAMS_AT_MOST or layout.columns_per_frame > _COLUMNS_AT_MOST:
            raise ValueError(f"{layout.pixels_per_column} beams, {layout.columns_per_frame} columns")
        height_m = float(np.asarray(info.lidar_to_sensor_transform)[2, 3]) / 1000
        ring = (-np.asarray(info.beam_altitude_angles)).argsort(kind="stable").argsort()
        points_of = XYZLut(info)
    except Exception as error:  # the library meets other JSON with whatever it stumbles over
        raise _unusable(metadata, error) from None
    check_packets(path, _FORMAT, _CURE)
    try:
        source = PcapFrameSetSource(str(path), sensor_info=[info], index=True)
        count = len(source)
    except Exception as error:  # and damaged packets too
        raise _unusable(path, error) from None
    if not count:
        raise ScanError(f"{path}, in which no revolution of the sensor in {metadata.name} is", _FORMAT, _CURE)
    return source, points_of, height_m, ring


def _metadata_of(path: Path) -> Path:
    metadata = path.with_suffix(".json")
    if metadata.is_file():
        return metadata
    if (maker := other_maker(path)) and OusterPcap.recognises(path):
        cure = "convert it by the maker's tool, or play it through its ROS driver and record the topic of point clouds"
        raise ScanError(f"{path}, no recording of an Ouster ({maker})", _FORMAT, cure)
    others = sorted(one.name for one in path.parent.glob("*.json")) if path.parent.is_dir() else []
    other_maker_cure = f"if an Ouster sent it, {_CURE}; else convert it by the maker's tool"
    cure = f"if it is {' or '.join(others[:3])}, give it that name" if others else other_maker_cure
    raise ScanError(f"{path} without {metadata.name}", _FORMAT, cure)


def _read_json(path: Path) -> dict[str, Any]:
    return read_json(path, dict, ScanError, _FORMAT, _CURE, _METADATA_BYTES_AT_MOST)


def _section(data: dict[str, Any], name: str) -> dict[str, Any]:
    section = data.get(name)
    return section if isinstance(section, dict) else {}


def _unusable(path: Path, error: Exception) -> ScanError:
    return ScanError(f"{path}, which cannot be used ({first_words(error)})", _FORMAT, _CURE)

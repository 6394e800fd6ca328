"""Range images that other programs saved as ``.npy``: one file, or a folder of nothing else → range images."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lidargrit.core import discovery, reporting
from lidargrit.core.arrays import ARRAY_BYTES_AT_MOST, parse_array
from lidargrit.core.determinism import evenly_spaced, natural_order
from lidargrit.core.errors import ConfigError, DataError, LidarGritError, ScanError, printable
from lidargrit.core.untrusted import user_path
from lidargrit.data import formats
from lidargrit.data.datasets.folder import Folder
from lidargrit.data.datasets.shared.files import SENSOR_FILE, is_recognised, scans_below
from lidargrit.data.formats import read_bytes
from lidargrit.data.images import Pixels, Provenance, RangeImages
from lidargrit.data.prepared.config import DEFAULTS, DataConfig
from lidargrit.data.sources.source import Source
from lidargrit.scans.sensors import SensorModel, load_sensor

PROBABILITY = ".probability.npy"  # how files end that tell the share of returns, and are no scans
_IMAGE = "a range image: an .npy of (H, W) ranges in metres"
_TOLD_BELOW = 0.9  # a tenth of the returns is no stray pixel
_WITHIN_AT_LEAST = 0.5  # of the pixels with a return: real images have nearly all, those in another unit next to none
_POINT_COLUMNS_AT_MOST = 5  # x, y, z, reflectance, ring: what is wider is an image


class ImageFileSource(Source):
    """Range images as ``.npy``, in metres, 0 or what is not finite where nothing returned."""

    kind = "range images"

    def __init__(self, text: str, folder: Path, paths: Sequence[Path]) -> None:
        super().__init__(text)
        self._folder, self._paths = folder, paths

    @property
    def sensor(self) -> SensorModel:
        """Sensor of the file beside the images, else that of a folder of scans if the first image has its size."""
        if (beside := self._folder / SENSOR_FILE).is_file():
            return load_sensor(str(beside))
        size, usual = _array(self._paths[0]).shape, load_sensor(Folder.sensor)
        if size == (usual.height, usual.width):
            return usual
        known = {name: load_sensor(name) for name in discovery.names("sensors")}
        fitting = [name for name, sensor in known.items() if size == (sensor.height, sensor.width)]
        raise ConfigError(
            f"range images of {'x'.join(map(str, size))} in {self.text}",
            f"the sensor of their rows and columns{', such as ' + ' or '.join(fitting) if fitting else ''}",
            "name it with --sensor NAME or FILE.json, which may have other columns",
        )

    def images(self, sensor: SensorModel | None = None, config: DataConfig = DEFAULTS) -> RangeImages:
        """Read the images, which have the rows and columns of the sensor."""
        sensor, count = sensor or self.sensor, len(self._paths)
        chosen = evenly_spaced(config.max_scans or count, count)
        return RangeImages(sensor, [_ImageFiles([self._paths[index] for index in chosen], sensor)])


def image_files(path: Path) -> list[Path]:
    """Return the range images that a path names: one ``.npy``, or those of a folder of nothing else; else none.

    They may all lie in one folder below.
    """
    found = [
        one for one in _entries(path) if one.is_file() and not one.name.startswith(".") and formats.candidates(one)
    ]
    found = [one for one in found if not one.name.endswith(PROBABILITY)]
    others = [one for one in found if one.suffix.lower() != ".npy"]
    if len(others) == len(found) or any(map(is_recognised, others)):
        return []
    first = next(one for one in found if one not in others)
    try:
        array = _parsed(first)
    except LidarGritError:  # told where the file is read as the points of a scan
        return []
    if array.ndim != 2 or array.shape[1] <= _POINT_COLUMNS_AT_MOST:
        return []
    if array.shape[0] <= _POINT_COLUMNS_AT_MOST and (array < 0).any():  # points by column, told as such elsewhere
        return []
    if others:
        what = f"{path}, with range images and {others[0].name}"
        raise DataError(what, "a folder of range images alone", "move that file elsewhere")
    _refuse_mask(array, first)
    for one in found:
        user_path(str(one.absolute()))  # refuses a name that is not UTF-8, which others could not write again
    below = (one for one in scans_below(path) if one.parent != first.parent and is_recognised(one))
    if path.is_dir() and (further := next(below, None)):
        what = f"{path}, with range images and, in {further.parent}, further scans"
        raise DataError(what, "a folder of range images alone", "move one of them elsewhere")
    return found


def _entries(path: Path) -> list[Path]:
    """Return what lies in a folder, or in the one folder below where it holds no scan itself."""
    try:
        found = [path] if path.is_file() else natural_order(path.iterdir())
        if any(formats.candidates(one) and one.is_file() for one in found):  # ends at the first of many files
            return found
        below = [one for one in found if one.is_dir() and not one.name.startswith(".")]
        return _entries(below[0]) if len(below) == 1 else found
    except (OSError, ValueError):
        return []


class _ImageFiles:
    def __init__(self, paths: list[Path], sensor: SensorModel) -> None:
        self.files, self._sensor, self._told = paths, sensor, False
        self.provenance = Provenance(tuple(str(path.absolute()) for path in paths))

    def __len__(self) -> int:
        return len(self.files)

    def read(self, index: int) -> Pixels:
        path, sensor = self.files[index], self._sensor
        range_m = _array(path)
        if range_m.shape not in {(sensor.height, sensor.width), (sensor.height, sensor.width * sensor.column_stride)}:
            raise ScanError(
                f"{path}, a range image of {'x'.join(map(str, range_m.shape))}",
                f"{sensor.height}x{sensor.width}, as the sensor {sensor.name!r} has",
                "render it with the rows and columns of this sensor",
            )
        with np.errstate(over="ignore"):  # infinite, and so out of the sensor's limits
            range_m = range_m.astype(np.float32)
        within = (range_m >= sensor.range_min_m) & (range_m <= sensor.range_max_m)
        inside, returns = int(within.sum()), int((range_m > 0).sum())
        if inside < _WITHIN_AT_LEAST * returns or not inside:  # a stray pixel within them shows no unit
            what = f"{inside or 'no'} of {returns:,} ranges within the sensor's limits in {path}"
            raise ScanError(
                what, f"ranges in metres, {sensor.range_min_m:g} to {sensor.range_max_m:g}", "check the unit"
            )
        if inside < _TOLD_BELOW * returns and not self._told:
            self._told = True
            limits = f"the sensor's limits, {sensor.range_min_m:g} to {sensor.range_max_m:g} m"
            what = f"{1 - inside / returns:.0%} of the ranges of {printable(str(path))} lie beyond {limits}"
            reporting.message(f"WARNING: {what}, and are left out; check the unit")
        return Pixels(np.where(within, range_m, np.float32(0)))


def _array(path: Path) -> np.ndarray:
    array = _parsed(path)
    _refuse_mask(array, path)
    return array


def _parsed(path: Path) -> np.ndarray:
    try:
        return parse_array(read_bytes(path, ARRAY_BYTES_AT_MOST, _IMAGE))
    except LidarGritError:
        raise
    except ValueError as error:
        raise ScanError(f"{path}, which cannot be read ({error})", _IMAGE, "save it anew") from None


def _refuse_mask(array: np.ndarray, path: Path) -> None:
    if array.dtype == bool:  # such as a mask for complete --observed
        raise ScanError(f"{path}, an array of truth values", _IMAGE, "move masks to another folder")

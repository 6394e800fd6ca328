"""Samples as other programs write them, in files of tensors or of text: folder → range images."""

import math
import re
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lidargrit.core import discovery
from lidargrit.core.arrays import mapped_member
from lidargrit.core.determinism import evenly_spaced
from lidargrit.core.errors import DataError, ScanError, kind_and_words
from lidargrit.data import formats
from lidargrit.data.images import Pixels, Provenance, RangeImages
from lidargrit.scans.sensors import SensorModel, load_sensor

_BYTES_AT_MOST = 1 << 30  # of one file, unpacked: a batch of 500 scans of 5 channels has 655 MB
_SCANS_AT_MOST = 1 << 20
_POINT_WITHOUT_COLOUR = re.compile(rb"(-?\d+\.\d{3} ){3}0\.000 0\.000 0\.000\r?\n")

RangeAndReflectance = tuple[Float[Tensor, "H W"], Float[Tensor, "H W"] | None]
"""Metres, 0 where nothing returned; reflectance in [0, 1] if there is one."""


def read_tensor(path: Path) -> Tensor:
    """Read the one tensor that a file holds; nothing else in it is looked at, and no code in it is run."""
    wanted, cure = f"one tensor of at most {_BYTES_AT_MOST >> 20} MB", "save it as one: torch.save(tensor, path)"
    try:
        if not path.is_file():  # a pipe would hang
            raise ValueError("not a file")
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > _BYTES_AT_MOST:
            raise ValueError(f"{size} bytes")
        tensor: Any = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(tensor, Tensor) or tensor.layout != torch.strided or tensor.is_nested or tensor.is_meta:
            raise TypeError(f"a {type(tensor).__name__} that holds no plain array of numbers")
        if tensor.numel() * tensor.element_size() > tensor.untyped_storage().nbytes():
            raise ValueError("a tensor larger than what the file holds")  # a stride of 0 can name terabytes
        if not tensor.is_floating_point():
            raise TypeError(f"numbers of type {tensor.dtype}")
    except Exception as error:  # damaged bytes make torch raise many kinds, for one cause
        raise ScanError(f"{path}, which cannot be used ({kind_and_words(error)})", wanted, cure) from None
    return tensor.detach().float()


@dataclass(frozen=True)
class SampleFormat:
    """The format in which one program stores its samples.

    Args:
        title: name of the program that writes such samples.
        channels: number of channels of its tensors, which are (channels, rows, columns) or (scans, channels, rows,
            columns).
        sensors: possible sensors, each as a name, the number of fine columns (0 for the sensor's own), and the step
            between the columns that are kept.
        variant: projection variant of its training scans.
        decode: function from the values of a tensor to metres.
        suffix: end of the names of its files.
        read: function that reads the tensor of a file.
    """

    title: str
    source: str
    channels: int
    sensors: tuple[tuple[str, int, int], ...]
    variant: str
    decode: Callable[[Tensor], RangeAndReflectance]
    suffix: str = ".pth"
    read: Callable[[Path], Tensor] = read_tensor

    def by_size(self) -> dict[tuple[int, ...], SensorModel]:
        """Return the possible sensors by the rows and columns of their images."""
        sensors = [(load_sensor(name), columns, stride) for name, columns, stride in self.sensors]
        chosen = [sensor.with_columns(columns, stride) if columns else sensor for sensor, columns, stride in sensors]
        return {(sensor.height, sensor.width): sensor for sensor in chosen}


def load_sample_format(name: str) -> SampleFormat:
    """Return a format of samples by its name, or raise UnknownNameError."""
    return discovery.load_instance("sample-formats", name.replace("-", "_"), SampleFormat)


def is_tensor_folder(folder: Path) -> bool:
    """Return whether a folder holds samples of another program, and no scans, beside which weights may lie."""
    try:
        if _holds_images_of_r3dpa(folder):  # beside a pickle that ends in .pcd
            return True
        samples = folder.is_dir() and (
            any(True for _ in folder.glob("[!.]*.pth")) or _holds_points_without_colour(folder)
        )
        return samples and not any(formats.candidates(path) for path in folder.iterdir())
    except OSError:  # a name longer than names can be
        return False


def samples_in(path: Path, name: str = "") -> Path | None:
    """Return the folder in which a path holds samples of another program, or None if it holds none.

    R3DPA writes pictures, an archive and text into three folders, LiDM pictures and text into two.

    Args:
        name: name of the wanted sample format; any if empty.
    """
    if path.name == "img.npz" and _holds_images_of_r3dpa(path.parent):
        return path.parent
    if not path.is_dir():
        return None
    folders, suffix = (path, path / "numpy", path / "pcd"), load_sample_format(name).suffix if name else ""
    return next((each for each in folders if (_files(each, suffix) if name else is_tensor_folder(each))), None)


def recognise(folder: Path) -> str:
    """Name the program that wrote a folder of samples, by its text or archive, or the channels of the first tensor."""
    if _holds_points_without_colour(folder):
        return "lidm"
    if _holds_images_of_r3dpa(folder):
        return "r3dpa"
    path = _paths(folder)[0]
    shape = tuple(read_tensor(path).shape)
    forms = {name: load_sample_format(name) for name in discovery.names("sample-formats")}
    known = {form.channels: name for name, form in forms.items() if form.suffix == ".pth"}
    if len(shape) < 3 or shape[-3] not in known:
        wanted = ", ".join(f"{channels} channels ({name})" for channels, name in sorted(known.items()))
        raise ScanError(f"a tensor of {shape} in {path}", wanted, "name what wrote it with --samples-format")
    return known[shape[-3]]


def read_tensor_folder(folder: Path, name: str = "", count: int | None = None) -> RangeImages:
    """Return the samples of a folder of tensors, in the order of their numbers; read when asked for.

    Args:
        folder: folder of files with one scan or one batch of scans each.
        name: name of the sample format; recognised from the number of channels if empty.
        count: largest number of scans, evenly spaced; all if not given.
    """
    form = load_sample_format(name or recognise(folder))
    store = _Tensors(_paths(folder, form.suffix), form, count)
    return RangeImages(store.sensor, [store])


def sensor_of_tensors(folder: Path, name: str = "") -> SensorModel:
    """Return the sensor that the first file of a folder of tensors fits."""
    form = load_sample_format(name or recognise(folder))
    path = _paths(folder, form.suffix)[0]
    return _sensor_of(form.read(path), path, form)


class _Tensors:
    def __init__(self, paths: list[Path], form: SampleFormat, count: int | None) -> None:
        self._format, self._last = form, (Path(), torch.empty(0))
        first = self._tensor(paths[0])
        self.sensor = _sensor_of(first, paths[0], form)
        self._scans: list[tuple[Path, int | None]] = []
        for path in paths:
            if first.ndim == 3:
                self._scans.append((path, None))
            else:
                self._scans += [(path, index) for index in range(min(len(self._batch(path)), _SCANS_AT_MOST))]
        if count:
            self._scans = [self._scans[index] for index in evenly_spaced(count, len(self._scans))]
        if not self._scans:
            raise DataError(f"no scan in {paths[0].parent}", "samples as tensors", "remove empty files, or sample anew")
        self.files = [path for path, _ in self._scans]
        self.provenance = Provenance(tuple(f"{path} {index or 0}" for path, index in self._scans))

    def __len__(self) -> int:
        return len(self._scans)

    def read(self, index: int) -> Pixels:
        path, index_in_file = self._scans[index]
        tensor = self._tensor(path)
        scan = tensor if index_in_file is None else tensor[index_in_file]
        if tuple(scan.shape) != (self._format.channels, self.sensor.height, self.sensor.width):
            wanted = f"{self._format.channels}x{self.sensor.height}x{self.sensor.width}, as the first"
            raise ScanError(f"a tensor of {tuple(scan.shape)} in {path}", wanted, "remove the file")
        range_m, reflectance = self._format.decode(scan)
        if not bool(((range_m >= 0) & (range_m < math.inf)).all()):
            raise ScanError(f"ranges that are negative or no number in {path}", "metres", "check what wrote it")
        planes = {} if reflectance is None else {"reflectance": _array(reflectance.nan_to_num().clamp(0, 1))}
        return Pixels(_array(range_m), planes)

    def _tensor(self, path: Path) -> Tensor:
        known, tensor = self._last  # one pair, replaced at once: safe from several threads
        if known != path:
            tensor = self._format.read(path)
            self._last = (path, tensor)
        return tensor

    def _batch(self, path: Path) -> Tensor:
        tensor = self._tensor(path)
        if tensor.ndim != 4:
            wanted = "a batch of scans, as the first"
            raise ScanError(f"a tensor of {tuple(tensor.shape)} in {path}", wanted, "remove the file")
        return tensor


def _sensor_of(first: Tensor, path: Path, form: SampleFormat) -> SensorModel:
    """Return the sensor whose images are as large as the tensor of a folder's first file."""
    shape = tuple(first.shape)
    fits, known = len(shape) in {3, 4} and shape[-3] == form.channels, form.by_size()
    if not fits or shape[-2:] not in known:
        sizes = " or ".join(f"{form.channels}x{h}x{w}" for h, w in known)
        raise ScanError(f"a tensor of {shape} in {path}", f"{sizes}: {form.title}", "check the format")
    return known[shape[-2:]]


def _array(values: Tensor) -> np.ndarray[Any, np.dtype[np.float32]]:
    return values.contiguous().numpy().astype(np.float32, copy=False)


def _paths(folder: Path, suffix: str = ".pth") -> list[Path]:
    if not (found := _files(folder, suffix)):
        raise DataError(f"no {suffix} file in {folder}", "samples, in files of their own", "check the folder")
    return found


def _files(folder: Path, suffix: str) -> list[Path]:
    return sorted(folder.glob(f"[!.]*{suffix}"), key=_order)


def _holds_points_without_colour(folder: Path) -> bool:
    """Return whether a folder holds text in which each line has x, y, z in millimetres and the three zeros of LiDM."""
    first = min(folder.glob("[!.]*.txt"), default=None)
    return first is not None and bool(_POINT_WITHOUT_COLOUR.match(formats.first_bytes(first, 100)))


def _holds_images_of_r3dpa(folder: Path) -> bool:
    """Return whether a folder holds the archive of R3DPA, with five channels of each scan."""
    try:
        shape = mapped_member(folder / "img.npz", "arr_0").shape
    except ValueError:
        return False
    return len(shape) == 4 and shape[1] == 5


def _order(path: Path) -> tuple[list[int], str]:
    """Return the numbers in a file's name, 10 after 9, then the name, since file systems have orders of their own."""
    return [int(number) for number in re.findall(r"\d{1,18}", path.stem)], path.name

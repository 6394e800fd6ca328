"""A source of scans → one file of compressed range images, and back into a file for each scan."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import torch

from lidargrit.core import reporting
from lidargrit.core.errors import CheckpointError, ConfigError, DataError, ScanError, UsageError, no_usable_scan
from lidargrit.core.shares import each_done
from lidargrit.core.version import __version__
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.run_folder import locate, projection_variant, told_of
from lidargrit.data.scan_folder import IMAGE, ScanFolder, ScanIdentity, check_names, writable_format, write_array
from lidargrit.data.sources.named import NamedScans
from lidargrit.generation.generator import load
from lidargrit.inference.complete.inputs import Inputs, ScanReader, open_inputs
from lidargrit.inference.compress.archive import Archive, Compressed, add_scan, writing
from lidargrit.inference.compress.coder import not_reproduced
from lidargrit.inference.compress.drives import DrivesOfSource, Place, PlacedScan, past_of
from lidargrit.inference.compress.points_command import holds_points, reader_of_points
from lidargrit.inference.compress.scan_codec import ScanCodec
from lidargrit.scans.many_scans import leaving_out
from lidargrit.scans.projection import unproject
from lidargrit.scans.sensors import SensorModel
from lidargrit.scans.types import RangeImage

_SHARE_ON_RAY = 4  # scans: seconds of work, for a task takes a cluster 30 ms


def compress_scans(
    source: str,
    out: Path,
    model: str,
    step_mm: int,
    config: DataConfig,
    ray: str = "",
    sensor: SensorModel | None = None,
) -> Compressed:
    """Write the range images of a source into one file, each read again before it is kept.

    Each is compressed by itself, or, by a model of drives, given those before it as the file has them.

    Args:
        out: file to write, which appears when it is whole; the same command goes on with one that was interrupted.
        model: run with a pixel decoder; scans are projected with its sensor, in the way of its training.
        config: number of scans, and what to do with unusable points and scans.
        ray: address of a Ray cluster that compresses; see :func:`each_done`.
        sensor: sensor of the scans, for a run that takes any, which the file then names; the run's own if not given.
    """
    work = _Work(source, model, step_mm, config, "" if sensor is None else json.dumps(sensor.to_json()))
    compressor = _Compressor.of(work)
    inputs, chosen = compressor.inputs, {"source": source, "max_scans": config.max_scans}
    names = [inputs.scans.name(index) for index in range(len(inputs))]
    check_names(source, names)  # of which a file has each once
    _tell_of_drives(inputs.scans, model)
    chosen |= {"projection": config.projection, "bad_points": config.bad_points, "bad_scans": config.bad_scans}
    with writing(out, _header(compressor.codec, model, sensor), chosen) as writer:
        missing = writer.missing([compressor.identity(index) for index in range(len(inputs))])
        do = partial(_write_some, work, writer.folder) if ray else partial(compressor.write, writer.folder)
        size = _SHARE_ON_RAY if ray else 1
        shares = [missing[first : first + size] for first in range(0, len(missing), size)]
        with reporting.progress("compressing", len(inputs), len(inputs) - len(missing)) as progress:
            for count in each_done(do, shares, ray=ray):
                progress.advance(count)
        returns = writer.sizes()
        if not returns:
            raise no_usable_scan(source)
    return Compressed(len(returns), sum(returns), out.stat().st_size)


def _tell_of_drives(scans: NamedScans, model: str) -> None:
    """Say that the bundle of a model has one of drives, if the scans are some whose past is known."""
    of_drives = locate(model, "drive")
    if of_drives == locate(model):
        return
    try:
        timed = scans.timed_scans()
    except DataError:  # in files beside the scans, which are not needed
        return
    drives = [one.recording for one in timed if one.motion.time_s is not None and one.motion.pose is not None]
    if len(drives) > len({*drives}):
        told = f"{len(drives)} scans have times and poses: --model {model}/{of_drives.name} makes the file smaller"
        reporting.message(f"{told}, by what earlier scans of a drive tell of later ones")


@dataclass(frozen=True)
class _Work:
    """What is compressed and how: all that a machine of a cluster needs to do some of it.

    Args:
        rays: sensor of the scans as JSON; "" for the model's own.
    """

    source: str
    model: str
    step_mm: int
    config: DataConfig
    rays: str = ""


class _Compressor:
    def __init__(self, codec: ScanCodec, inputs: Inputs, skips: bool) -> None:
        self.codec, self.inputs, self._skips, self._told = codec, inputs, skips, False
        self._drives = DrivesOfSource(inputs.scans.timed_scans(), codec.past_scans) if codec.past_scans else None
        self._image = lru_cache(maxsize=2 * codec.past_scans + 1)(self._read)

    @classmethod
    def of(cls, work: _Work) -> "_Compressor":
        sensor = SensorModel.from_json(json.loads(work.rays)) if work.rays else None
        codec, config = _codec(work.model, work.step_mm, sensor), work.config
        reader = ScanReader(codec.sensor, projection_variant(locate(work.model)), projection=config.projection)
        return cls(codec, open_inputs(work.source, reader, config), config.bad_scans == "skip")

    def identity(self, index: int) -> str:
        """Return what identifies a scan; of a drive its place, too, by which those behind it are compressed."""
        named = str(self.inputs.scans.identity(index))
        return named if self._drives is None else f"{named}, placed at {self._drives.place(index, 0)[1:]}"

    def write(self, folder: Path, indices: Sequence[int]) -> int:
        for index in indices:
            data, returns, image = b"", 0, self._image(index)
            with leaving_out(self._skips):
                if isinstance(image, ScanError):
                    raise image
                data, returns = self._compress(index, image), int(image.return_mask.sum())
                if not self._told and (lost := _not_kept(image)):
                    self._told = True
                    reporting.message(f".lgz keeps no {lost}")
            add_scan(folder, index, (self.inputs.scans.name(index), self.identity(index), returns), data)
        return len(indices)

    def _read(self, index: int) -> RangeImage | ScanError:
        """Return the image of a scan, or why it is left out."""
        try:
            return self.inputs.read(index).image
        except ScanError as error:
            if not self._skips:
                raise
            return error

    def _compress(self, index: int, image: RangeImage) -> bytes:
        drives = self._drives
        if drives is None:
            return self.codec.compress(image)
        images = [(at, self._image(at)) for at in drives.before(index)]
        there = [(at, self.codec.rounded(one)) for at, one in images if isinstance(one, RangeImage)]
        place = drives.place(index, len(there))
        before = [PlacedScan(drives.place(at, 0), one) for at, one in there]
        try:
            return place.to_bytes() + self.codec.compress(image, past_of(place, before))
        except ScanError as error:  # it cannot be left out: later scans are compressed as if it were there
            raise ConfigError(error.got, error.wanted, "name another --step-mm") from None


_compressor_of = lru_cache(maxsize=1)(_Compressor.of)  # for all shares of a worker


def _write_some(work: _Work, folder: Path, indices: Sequence[int]) -> int:
    return _compressor_of(work).write(folder, indices)


def decompress_scans(path: Path, out: Path, model: str | None, kind: str | None, chosen: Sequence[int]) -> int:
    """Write the scans of a compressed file as they were, and return their number.

    The whole file is checked before anything is written, and each scan's pixels before its own file.

    Args:
        path: file that :func:`compress_scans` or :func:`compress_points` wrote.
        out: an empty folder, or one that the same command began: files that are there are not written again.
        model: run by which it was compressed, ``pretrained`` if not given; points have none.
        kind: ``image`` for range images (H, W) in metres as ``.npy``, or name or ending of a format for points; if not
            given, range images of a model's file, and KITTI's ``.bin`` of a file of points.
        chosen: indices of the scans that are wanted; all if there is none.
    """
    archive = Archive(path)
    is_of_points = holds_points(archive)
    if model and is_of_points:
        raise UsageError(f"--model {model} for {path}, which holds points", "no model", "leave --model out")
    kind = kind or ("bin" if is_of_points else IMAGE)
    if kind == IMAGE and is_of_points:
        got = f"--format image for {path}, which holds points"
        raise UsageError(got, "a format of points", "leave --format out, or name bin, pcd, ply or npz")
    form, suffix = (None, ".npy") if kind == IMAGE else writable_format(kind, IMAGE)
    wrong = [index for index in chosen if not 0 <= index < len(archive)]
    if wrong:
        wanted = f"indices from 0 to {len(archive) - 1}" if len(archive) else f"no index: {path} holds no scans"
        raise UsageError(f"--only {wrong[0]}", wanted, "correct it" if len(archive) else "name another file")
    archive.check()
    indices = list(dict.fromkeys(chosen)) or range(len(archive))
    step_mm, read, sensor = (*reader_of_points(archive), None) if is_of_points else _reader(archive, model)
    names = [archive.names[index] for index in indices]
    facts = {"source": path.name, "index_crc32": archive.index_crc32, "step_mm": step_mm, "format": kind}
    folder = ScanFolder(out, "decompressed.json", facts, [name + suffix for name in names], [*map(ScanIdentity, names)])
    with folder.writing("decompressing") as progress:
        for number in folder.missing:
            found, file = read(indices[number]), out / folder.files[number]
            if sensor is not None:
                folder.tell_sensor(sensor)
            if isinstance(found, RangeImage) and form is None:
                write_array(file, found.range_m)
            elif form is not None:
                form.write(file, unproject(found) if isinstance(found, RangeImage) else found)
            progress.advance(1)
    return folder.num_written


def _reader(archive: Archive, model: str | None) -> tuple[int, Callable[[int], RangeImage], SensorModel]:
    """Return the step in millimetres of a file of range images, what reads one by its index, and their sensor."""
    codec = _codec_of(archive, model or "pretrained")
    read = _Drives(archive, codec).read if codec.past_scans else lambda index: codec.decompress(archive.read(index))
    return codec.steps.step_mm, read, codec.sensor


class _Drives:
    """Decompresses scans that were compressed given those before them, of which the last ones are kept."""

    def __init__(self, archive: Archive, codec: ScanCodec) -> None:
        self._archive, self._codec, self._last = archive, codec, dict[int, PlacedScan]()

    def read(self, index: int) -> RangeImage:
        first = index
        while first not in self._last and self._split(first)[0].before:
            first -= 1
        for number in range(first, index + 1):
            if number not in self._last:
                place, compressed = self._split(number)
                before = [self._last[at] for at in range(number - place.before, number)]
                image = self._codec.decompress(compressed, past_of(place, before))
                self._last = {at: one for at, one in self._last.items() if number - self._codec.past_scans < at}
                self._last[number] = PlacedScan(place, image)
        return self._last[index].image

    def _split(self, index: int) -> tuple[Place, bytes]:
        place, compressed = Place.split(self._archive.read(index))
        if place.before > min(index, self._codec.past_scans):
            raise not_reproduced()
        return place, compressed


def _not_kept(image: RangeImage) -> str:
    """Return what an image holds besides the ranges, which alone are compressed."""
    held = (("reflectance", image.reflectance), ("labels", image.label))
    return " and no ".join(name for name, pixels in held if pixels is not None)


def _codec(model: str, step_mm: int, sensor: SensorModel | None) -> ScanCodec:
    generator = load(model)
    return ScanCodec(generator if sensor is None else generator.for_sensor(sensor), step_mm)


def _header(codec: ScanCodec, model: str, given: SensorModel | None) -> dict[str, Any]:
    sensor = codec.sensor
    rays = {} if given is None else {"rays": given.to_json()}
    return {
        **rays,
        "model": Path(model).name if Path(model).exists() else model,  # such as pretrained/forecaster
        "model_sha256": codec.digest(),
        "step_mm": codec.steps.step_mm,
        "sensor": sensor.name,
        "size": [sensor.height, sensor.width],
        "lidargrit": __version__,
        "torch": torch.__version__,
    }


def _codec_of(archive: Archive, model: str) -> ScanCodec:
    step_mm, digest = archive.header.get("step_mm"), archive.header.get("model_sha256")
    if not (isinstance(step_mm, int) and isinstance(digest, str)):
        raise not_reproduced()
    rays = archive.header.get("rays")
    with told_of(archive.path):
        sensor = None if rays is None else SensorModel.from_json(rays)
    codec = _codec(model, step_mm, sensor)
    if codec.digest() != digest:
        archive_of = f"{archive.path}, compressed by the model {archive.header.get('model')!r} of hash {digest[:12]}"
        cure = f"name that run with --model: {model} has the hash {codec.digest()[:12]}"
        raise CheckpointError(archive_of, "the same model to decompress it", cure)
    return codec

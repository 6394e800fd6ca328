"""A source of scans → one file of compressed points, and back into a file of points for each scan."""

from collections.abc import Callable
from pathlib import Path

import torch

from lidargrit.core import reporting
from lidargrit.core.errors import UsageError, no_usable_scan
from lidargrit.core.untrusted import STEP_MM_AT_MOST
from lidargrit.core.version import __version__
from lidargrit.data.prepared.config import DataConfig
from lidargrit.data.scan_folder import check_names
from lidargrit.data.sources import open_source
from lidargrit.data.sources.named import PointScans, named_scans
from lidargrit.inference.compress.archive import Archive, Compressed, add_scan, writing
from lidargrit.inference.compress.coder import not_reproduced
from lidargrit.inference.compress.point_codec import Cloud, PointCodec
from lidargrit.scans.many_scans import leaving_out
from lidargrit.scans.types import Scan

_MARK = "points"  # entry of the header by which such a file is known
_NOT_KEPT = (("label", "labels"), ("point_time_s", "times of points"))


def compress_points(source: str, out: Path, step_mm: int, config: DataConfig) -> Compressed:
    """Write all points of the scans of a source into one file, each scan by itself.

    Args:
        out: file to write, which appears when it is whole; the same command goes on with one that was interrupted.
        step_mm: twice as much as any coordinate may change, in millimetres.
        config: number of scans, and what to do with unusable points and scans.
    """
    codec, scans = PointCodec(step_mm), named_scans(open_source(source, config.bad_points), config)
    if not isinstance(scans, PointScans):
        raise UsageError(f"range images in {source} with --points", "scans of points", "leave --points out")
    names = [scans.name(index) for index in range(len(scans))]
    check_names(source, names)  # of which a file has each once
    chosen = {"source": source, "max_scans": config.max_scans}
    chosen |= {"bad_points": config.bad_points, "bad_scans": config.bad_scans}
    header, told = {_MARK: True, "step_mm": step_mm, "lidargrit": __version__}, False
    with writing(out, header, chosen) as writer:
        identities = [str(scans.identity(index)) for index in range(len(scans))]
        missing = writer.missing(identities)
        with reporting.progress("compressing", len(scans), len(scans) - len(missing)) as progress:
            for index in missing:
                data, count = b"", 0
                with leaving_out(config.bad_scans == "skip"):
                    scan = scans.scan(index)
                    scans.tell_notes(scan)
                    data, count = codec.compress(_cloud(scan)), len(scan)
                    lost = [word for name, word in _NOT_KEPT if getattr(scan, name) is not None]
                    if lost and not told:
                        reporting.message(f".lgz keeps no {' and no '.join(lost)}")
                    told = told or bool(lost)
                add_scan(writer.folder, index, (names[index], identities[index], count), data)
                progress.advance(1)
        counts = writer.sizes()
        if not counts:
            raise no_usable_scan(source)
    return Compressed(len(counts), sum(counts), out.stat().st_size)


def holds_points(archive: Archive) -> bool:
    """Return whether a file of compressed scans is of points."""
    return archive.header.get(_MARK) is True


def reader_of_points(archive: Archive) -> tuple[int, Callable[[int], Scan]]:
    """Return the step in millimetres of a file of points, and what reads one of its scans by its index."""
    step_mm = archive.header.get("step_mm")
    if not (isinstance(step_mm, int) and 1 <= step_mm <= STEP_MM_AT_MOST):
        raise not_reproduced()
    codec = PointCodec(step_mm)

    def read(index: int) -> Scan:
        points_m, reflectance = codec.decompress(archive.read(index))
        known = None if reflectance is None else torch.from_numpy(reflectance)
        return Scan(torch.from_numpy(points_m), known, source=f"{archive.path}, scan {archive.names[index]}")

    return step_mm, read


def _cloud(scan: Scan) -> Cloud:
    reflectance = None if scan.reflectance is None else scan.reflectance.numpy()
    return Cloud(scan.points_xyz_m.numpy(), reflectance)

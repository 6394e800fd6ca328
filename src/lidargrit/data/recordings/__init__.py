"""Drives as recordings with a time line: scans → one file that viewers play; one kind of file = one file here."""

from collections.abc import Iterable, Iterator
from importlib import import_module
from pathlib import Path, PurePosixPath

from lidargrit.core.errors import OutputError, ScanError
from lidargrit.core.files import atomic_path
from lidargrit.scans.types import Scan

KINDS = ("mcap", "rrd")
"""Endings of the files, and names of the modules that write them."""
_SECONDS_END = 2**31  # of a stamp of ROS, in 2038
_FRAME_S = 0.1  # between scans whose times are not known: most lidars turn ten times a second


def recording_of(name: str) -> str:
    """Return which recording holds a scan, by the scan's own name: its folder, or its file of several; "." for none.

    Example:
        >>> recording_of("00/000012"), recording_of("drive#3"), recording_of("000001")
        ('00', 'drive', '.')
    """
    path = PurePosixPath(name)
    file, of_several, _ = path.name.rpartition("#")
    return str(path.with_name(file) if of_several and file else path.parent)


def write_recording(path: Path, kind: str, scans: Iterable[Scan]) -> None:
    """Write the scans of one drive to a new file, in the order given; no more than one is in memory.

    Args:
        kind: one of :data:`KINDS`.
        scans: scans with their times and poses; one without a time follows 0.1 s after the one before it.
    """
    write = import_module(f"{__name__}.{kind}").write
    try:
        with atomic_path(path) as temporary:
            write(temporary, path.stem, _timed(scans))
    except ImportError as error:
        extra = "ros" if kind == "mcap" else "rerun"
        got = f"no {error.name or extra} to write {path}"
        raise OutputError(got, "it installed", f"pip install 'lidargrit[{extra}]'") from None


def _timed(scans: Iterable[Scan]) -> Iterator[tuple[float, Scan]]:
    time_s = -_FRAME_S
    for scan in scans:
        time_s = time_s + _FRAME_S if scan.time_s is None else scan.time_s
        if not 0 <= time_s < _SECONDS_END:
            got, wanted = f"a time of {time_s:g} s of {scan.source}", "seconds from 0 on, or since 1970"
            raise ScanError(got, wanted, "correct times.txt, or whatever tells its times")
        yield time_s, scan

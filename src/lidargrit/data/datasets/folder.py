"""Your own scans, in any format that is known and several at once: ROOT/** → scans."""

import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from lidargrit.core.determinism import natural_order
from lidargrit.core.errors import printable
from lidargrit.data import formats
from lidargrit.data.datasets import files_of_others
from lidargrit.data.datasets.shared.files import FileDataset, is_recognised, scans_below, unnamed_recording
from lidargrit.data.datasets.shared.labels_beside import label_file, with_labels
from lidargrit.data.formats import BadPoints
from lidargrit.data.formats.kitti_bin import KittiBin
from lidargrit.data.formats.numpy_array import holds_points
from lidargrit.scans.types import Scan

_SHARED_ENDINGS = (".png", ".csv", ".npy")  # of pictures, poses and labels, too
_TOPIC = re.compile(r"(/[^\[\]]+)(\[[^\]]*\])?")


class Folder(FileDataset):
    """A folder of scans, or one file; a sequence is the folder that holds them, "." for the root itself.

    Every file whose ending belongs to a format is a scan, hidden ones left out, and pictures, poses and labels beside
    scans (.png, .csv and .npy that hold no points). The sensor is that of a file ``sensor.json`` in the root, else that
    of the first file's format, if such files always have the same, and the HDL-64E of KITTI otherwise; choose yours
    with ``data.sensor``. A scan in ``velodyne`` has the labels in ``labels/NAME.label`` of SemanticKITTI beside it.
    """

    title = "a folder of scan files"
    licence = "that of your files"
    tree = "ROOT/**/FILE of any known format (lidargrit list formats)"
    sensor = "hdl64e_kitti_odometry"
    format = ""
    citation = "that of your files"
    patterns = ("**/*",)

    def __init__(self, root: Path, split: str = "all", bad_points: BadPoints = "refuse") -> None:
        found = _TOPIC.fullmatch(split)
        if found:
            self.topic, split = found[1], f"all{found[2] or ''}"
        super().__init__(root, split, bad_points)
        self.notes = tuple(self._left_out())
        sensors = [one.sensor for one in formats.candidates(self.path(0)) if one.sensor]
        self.sensor = self._sensor_beside()
        if sensors and self.sensor == type(self).sensor:
            self.sensor = sensors[0]

    def _left_out(self) -> Iterator[str]:
        """Yield notes on files that are no scans, or not read."""
        if beside := self._beside:
            what = f"{len(beside):,} {'file' if len(beside) == 1 else 'files'}"
            endings = ", ".join(sorted({path.suffix.lower() for path in beside}))
            yield f"{what} {endings} beside the scans left out, such as {printable(beside[0].name)[:80]}"
        if self.root.is_dir() and (others := files_of_others(self.root)):
            count = len({path for path, _ in self._scans})
            yield f"{others[0]} beside {count:,} that are read left out; {others[1]}"

    def takes_files_in(self, folder: Path) -> bool:
        """Return whether a folder is the root or lies below it, at whatever depth."""
        return self.root.is_dir() and folder.resolve().is_relative_to(self.root.resolve())

    @classmethod
    def matches(cls, root: Path) -> bool:
        """Return whether a folder holds a file with the ending of a scan, or a single file has one."""
        return next(scans_below(root), None) is not None

    def _find(self) -> list[Path]:
        scans, self._beside = _without_sidecar_files(scans_below(self.root))
        return natural_order(scans)

    def scan(self, index: int) -> Scan:
        """Read one scan, with SemanticKITTI's labels if it lies in a sequence that has them."""
        scan, path = super().scan(index), self.path(index)
        return with_labels(scan, path) if _may_have_labels(path) and formats.recognise(path) is KittiBin else scan

    def sidecar_files(self, index: int) -> tuple[Path, ...]:
        """Return the other files that a scan is read from, and its labels."""
        path = self.path(index)
        return (*super().sidecar_files(index), *([label_file(path)] if _may_have_labels(path) else []))

    def recording_of(self, path: Path) -> str:
        """Name a recording by its folder."""
        return unnamed_recording(path)


def _may_have_labels(path: Path) -> bool:
    return path.suffix == ".bin" and path.absolute().parent.name == "velodyne"


def _without_sidecar_files(found: Iterable[Path]) -> tuple[list[Path], list[Path]]:
    """Divide files into scans and what lies beside them: pictures, poses and labels, voxels of SemanticKITTI.

    Of endings that other files have as well, the first file in each folder tells; without scans of other endings all of
    them count, so that reading them says what is wrong.
    """
    kinds: dict[tuple[Path, str], list[Path]] = {}
    for path in found:
        kinds.setdefault((path.parent, path.suffix.lower()), []).append(path)
    beside = [
        key
        for key, paths in kinds.items()
        if (key[1] in _SHARED_ENDINGS and not is_points(min(paths)))
        or (key[0].name == "voxels" and any(folder == key[0].parent / "velodyne" for folder, _ in kinds))
    ]
    if len(beside) == len(kinds):
        beside = []
    scans = [path for key, paths in kinds.items() if key not in beside for path in paths]
    return scans, [path for key in beside for path in kinds[key]]


def is_points(path: Path) -> bool:
    """Return whether a file that is called like a scan, and may be something else, looks like one."""
    return is_recognised(path) and (path.suffix.lower() != ".npy" or holds_points(path))

"""What data sets share that a library of their makers reads: a folder of drives → scans of the first LiDAR of each."""

from abc import abstractmethod
from pathlib import Path
from typing import ClassVar, Protocol, runtime_checkable

from lidargrit.core.errors import DataError, ScanError, first_words
from lidargrit.core.files import remembered
from lidargrit.data.datasets.shared.files import FileDataset, hashed_name
from lidargrit.data.formats import BadPoints
from lidargrit.scans.motion import Motion
from lidargrit.scans.types import Scan


@runtime_checkable
class Drive(Protocol):
    """One LiDAR of a drive that a library has opened."""

    def __len__(self) -> int:
        """Return the number of its scans."""
        ...

    def scan(self, index: int, bad_points: BadPoints) -> Scan:
        """Read one scan."""
        ...

    def motion(self, index: int) -> Motion:
        """Return when and where a scan was made."""
        ...


class LibraryDataset(FileDataset):
    """Drives that a library reads, which this program does not install by itself."""

    format = ""
    library: ClassVar[str]
    """Name of the library in the package index."""

    @classmethod
    @abstractmethod
    def open_drive(cls, path: Path) -> Drive:
        """Open the drive of a file."""

    @classmethod
    def _opened(cls, path: Path) -> Drive:
        try:
            return _opened_once(cls, path)
        except ImportError:
            cure = f"pip install 'lidargrit[{cls.public_name()}]', in an environment of its own"
            raise DataError(f"{path}, which takes {cls.library} to read", "it installed", cure) from None
        except DataError:
            raise
        except Exception as error:  # libraries meet damaged files with whatever they stumble over
            raise cls._unusable(path, error) from None

    @classmethod
    def _unusable(cls, path: Path, error: Exception) -> DataError:
        cure = "copy it anew, or leave it out"
        return DataError(f"{path}, which {cls.library} cannot read ({first_words(error)})", cls.tree, cure)

    def name(self, index: int) -> str:
        """Name one scan by its drive and its number there."""
        path, number = self._scans[index]
        return f"{self.sequence_of(path.relative_to(self.root))}#{number}"

    def within(self, index: int) -> str:
        """Return which scan of its drive a scan is."""
        return f"#{self._scans[index][1]}"

    @classmethod
    def scans_in(cls, path: Path, topic: str = "") -> int:
        """Count the scans of a drive's first LiDAR."""
        return len(cls._opened(path))

    def scan(self, index: int) -> Scan:
        """Read one scan."""
        path, number = self._scans[index]
        drive = self._opened(path)
        try:
            return drive.scan(number, self.bad_points)
        except ScanError:
            raise
        except Exception as error:
            unusable = self._unusable(path, error)
            raise ScanError(f"scan {number} of {unusable.got}", unusable.wanted, unusable.cure) from None

    def motion(self, index: int) -> Motion:
        """Return time and pose of a scan, as its drive tells."""
        path, number = self._scans[index]
        return self._opened(path).motion(number)

    def sidecar_files(self, index: int) -> tuple[Path, ...]:
        """Return nothing: the library finds what lies beside a file."""
        return ()

    def recording_of(self, path: Path) -> str:
        """Name a recording by its file."""
        return hashed_name(path.resolve())

    @classmethod
    def _pattern_in(cls, root: Path) -> str | None:
        return next((pattern for pattern in cls.patterns if any(root.glob(pattern))), None)


@remembered(lambda cls, path: [path], at_most=2)  # scans are read drive by drive
def _opened_once(cls: type[LibraryDataset], path: Path) -> Drive:
    return cls.open_drive(path)

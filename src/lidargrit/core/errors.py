"""One exception tree; every message says what was got, what was wanted, and the cure.

LidarGritError (ValueError)
├── UsageError        the words of a command are not such as it knows
├── ScanError         a scan file, or the points in it, cannot be used
├── DataError         a folder or a data source is not what was asked for
│   └── ClusterError  workers of a cluster died
├── UnknownNameError  no sensor, preset, metric, ... of that name
├── ConfigError       a preset's setting is unknown or out of its bounds
├── CheckpointError   weights or a run that are damaged or of another configuration
├── WeightsError      published weights of a network that are not to be had, or not what they should be
├── OutputError       a file or folder to write is taken, or could not be written
│   └── HeldError     another process writes into the folder
└── TrainingError     training cannot go on: the loss is not a number, the codebook collapsed

``Terminated`` is no mistake: SIGTERM ended the work.
"""

import difflib
import re
from collections.abc import Iterable, Sequence

OR_LEAVE_IT_OUT = ", or of several leave it out by --bad-scans skip"
_LETTERS_AT_MOST = 600  # of each part of a message: a long path in full, or a few
_ROOT, _LETTERS_OF_A_PATH = r"(?:~|[A-Za-z]:)?[/\\]", r"[^\s,;:)'\"<>]*"
_ABSOLUTE_PATH = re.compile(rf"(?<![\w.…]){_ROOT}{_LETTERS_OF_A_PATH}")
_PATH_OF_A_SOURCE = re.compile(rf"(?:^|(?<=:)){_ROOT}[^:]*")  # of NAME:PATH:SPLIT, or alone
_SURELY_MEANT = 0.85  # of difflib's likeness: one letter wrong, missing or doubled in a name of seven


class LidarGritError(ValueError):
    """A user's mistake, printed in one line: what was got, what was wanted, the cure.

    Parts may quote names of files and other foreign text, which :func:`one_line` makes safe to print.
    """

    def __init__(self, got: str, wanted: str, cure: str) -> None:
        self.got, self.wanted, self.cure = one_line(got), one_line(wanted), one_line(cure)
        super().__init__(f"got {self.got}; wanted {self.wanted}; {self.cure}")

    def __reduce__(self) -> "tuple[type[LidarGritError], tuple[str, str, str]]":
        return type(self), (self.got, self.wanted, self.cure)


class UsageError(LidarGritError):
    """The words of a command are unknown or do not fit each other."""


class ScanError(LidarGritError):
    """A scan file, or the points in it, cannot be used."""

    def as_left_out(self) -> "ScanError":
        """Return the error without the cure to leave the scan out, for where scans are left out anyway."""
        return type(self)(self.got, self.wanted, self.cure.removesuffix(OR_LEAVE_IT_OUT))


class DataError(LidarGritError):
    """A folder or a data source is not what was asked for."""


class ClusterError(DataError):
    """Workers of a cluster died; the same command goes on."""


class UnknownNameError(LidarGritError):
    """No sensor, preset, metric, ... of that name."""


class ConfigError(LidarGritError):
    """A preset's setting is unknown or out of its bounds."""


class CheckpointError(LidarGritError):
    """Weights or a run that are damaged or of another configuration."""


class WeightsError(LidarGritError):
    """Published weights of a network cannot be found, or are not the right ones."""


class OutputError(LidarGritError):
    """A file or folder to write is taken, or could not be written."""


class HeldError(OutputError):
    """Another process writes into the folder."""


class TrainingError(LidarGritError):
    """Training cannot go on."""


class Terminated(KeyboardInterrupt):  # its kin, so that what cleans up after Ctrl-C does so here
    """SIGTERM ended the work; nobody's mistake."""


def one_line(text: str) -> str:
    r"""Return a text as one short line that a terminal shows as it is.

    Line breaks, control characters, marks that turn the direction of writing, and bytes of a file name that are no text
    are written as escapes such as ``\n``; the middle of a long text is left out.

    Example:
        >>> one_line("scan\x1b[2J.bin")
        'scan\\x1b[2J.bin'
    """
    if len(text) > _LETTERS_AT_MOST:
        text = f"{text[: _LETTERS_AT_MOST * 2 // 3]} [...] {text[-_LETTERS_AT_MOST // 3 :]}"
    return printable(text)


def printable(text: str) -> str:
    """Return a text with escapes such as ``\\n`` for whatever a terminal would not show as it is, like one_line."""
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)


def first_words(error: Exception) -> str:
    """Return what a library says of an error, in one line of at most 120 letters; of a file's, without its name."""
    said = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return "".join(filter(str.isprintable, " ".join(said.split())))[:120] or type(error).__name__


def kind_and_words(error: Exception) -> str:
    """Return the class of an error and the first line of what is said of it, which alone may be a bare name."""
    return f"{type(error).__name__}: {str(error).partition(chr(10))[0][:120]}"


def without_folders(text: str, sources: Iterable[str] = ()) -> str:
    """Return a text in which absolute paths have lost their folders, for pages and files that others will read.

    Args:
        text: text that may hold paths.
        sources: sources and paths that the text may name, as the user typed them. Their folders may have any letters;
            other paths are known only up to the next space, bracket or quotation mark.

    Example:
        >>> without_folders("no scan in /data/jane doe/scans", ["kitti_360:/data/jane doe/scans:train"])
        'no scan in …/scans'
        >>> without_folders("kitti_360:/data/mine/kitti_360:train against ~/runs/mine/samples")
        'kitti_360:…/kitti_360:train against …/samples'
    """

    def last_name(found: re.Match[str]) -> str:
        return "…/" + re.split(r"[/\\]", found[0].rstrip("/\\"))[-1]

    paths = [found[0] for source in sources if (found := _PATH_OF_A_SOURCE.search(source.rstrip("/\\")))]
    for path in sorted(paths, key=len, reverse=True):
        text = re.sub(rf"(?<![\w.…]){re.escape(path)}{_LETTERS_OF_A_PATH}", last_name, text)
    return _ABSOLUTE_PATH.sub(last_name, text)


def nearest_names(name: str, known: Iterable[str], at_most: int = 3) -> str:
    """Return the known names most like a given one, for a message: "a, b or c"; only one if it is clearly meant.

    Example:
        >>> nearest_names("bev_msd", ["bev_mmd", "bev_jsd", "coverage"])
        'bev_mmd or bev_jsd'
        >>> nearest_names("slicd_wasserstein", ["sliced_wasserstein", "lidm_bev_matching"])
        'sliced_wasserstein'
    """
    names = sorted(set(known))
    begun = [each for each in names if name and each.startswith(name)]
    alike = difflib.get_close_matches(name, names, n=at_most, cutoff=0.4)
    close = [*begun, *(each for each in alike if each not in begun)][:at_most] or names[:at_most]
    surely = difflib.get_close_matches(name, names, n=2, cutoff=_SURELY_MEANT)
    return one_of(surely if len(surely) == 1 else close)


def one_of(names: Sequence[str]) -> str:
    """Return names as a message offers them: "a, b or c"."""
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " or " + names[-1]


def no_usable_scan(source: str) -> "DataError":
    """Return the error of a source every scan of which was left out, each with a message of its own."""
    return DataError(f"no usable scan in {source}", "at least one", "see the messages above")


def counted_scans(count: int, kind: str = "") -> str:
    """Say a number of scans: "1 scan", "3 completed scans"."""
    return f"{count:,} {kind}{' ' if kind else ''}{'scan' if count == 1 else 'scans'}"

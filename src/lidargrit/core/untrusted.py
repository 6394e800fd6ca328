"""Untrusted words and JSON → values of bounded size, or an error of one line.

All bounds of what a command line, a JSON file or a message may ask for stand here; those of arrays in ``arrays.py``.
"""

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NoReturn

from lidargrit.core.errors import CheckpointError, DataError, LidarGritError, UsageError, first_words

JSON_BYTES_AT_MOST = 64 * 2**20  # the scans of the largest data set, 400,000, take 40 MB; parsed, bytes become tenfold
TEXT_BYTES_AT_MOST = 2**20  # notes for a model card
JSON_DEPTH_AT_MOST = 32  # our own files nest 8 deep; Python gives up at about 1,000
SEED_AT_MOST = 2**32 - 1  # PyTorch's generator on a CPU takes the last 32 bits of any other
WHOLE_NUMBER_AT_MOST = 2**63 - 1  # of settings: what 64 bits hold
COUNT_AT_MOST = 10_000_000  # scans, columns, steps, processes: ten times the largest data set
TEMPERATURE_AT_LEAST = 1e-6  # besides 0: by a smaller one, logits and densities overflow
STEPS_AT_MOST = 100_000  # of a sampler: a hundred times those of any published one
SEARCH_STEPS_AT_MOST = 10_000  # of a search for latents, which keeps random numbers for each: ten times the published
PROCESSES_AT_MOST = 1024  # on one machine
FRAMES_AT_MOST = 100_000  # of a simulated drive, which are 20 to 220 km
PAGE_SCANS_AT_MOST = 100  # of each source: about 15 MB of a KITTI-360 size image, which browsers still open at once
STEP_MM_AT_MOST = 1000  # in which ranges are kept
RAISED_AT_MOST_M = 10.0
NUMBER_AT_MOST = 1e30  # operations of the largest training ever: 1e27
PATH_BYTES_AT_MOST = 4096  # Linux; others allow less
NAME_BYTES_AT_MOST = 255  # of one file or folder, on all common file systems


def parse_json(
    data: bytes | str,
    source: str,
    kind: type = dict,
    error: type[LidarGritError] = CheckpointError,
    wanted: str = "JSON that lidargrit wrote",
    cure: str = "restore the file",
    at_most: int = JSON_BYTES_AT_MOST,
) -> Any:
    """Parse JSON of bounded size and depth.

    Args:
        source: name of the file or message, for the error.
        wanted: description of valid content, for the error.
        cure: advice to the user, for the error.

    Raises:
        LidarGritError: it is too large, too deep, not JSON, not of this type, or holds NaN or a number that no float
            can hold; of the class ``error``.

    Example:
        >>> parse_json('{"seed": 1}', "a message")
        {'seed': 1}
    """
    try:
        if len(data) > at_most:
            raise ValueError(f"more than {at_most:,} bytes")
        value = json.loads(data, parse_constant=_refuse_constant, parse_float=_finite, parse_int=_whole)
        if _is_deep(value):
            raise RecursionError
        if not isinstance(value, kind):
            raise TypeError(f"{_JSON_NAMES[type(value)]} in place of {_JSON_NAMES[kind]}")
    except RecursionError:
        why = f"nested more than {JSON_DEPTH_AT_MOST} deep"
        raise error(f"{source}, which cannot be used ({why})", wanted, cure) from None
    except (ValueError, TypeError) as why:
        raise error(f"{source}, which cannot be used ({first_words(why)})", wanted, cure) from None
    return value


def check_word(word: str) -> str:
    """Return a word of the command line if messages, files and other programs can hold it.

    Raises:
        UsageError: it holds NUL, is not UTF-8, or the locale cannot show it: libraries fail at such text.
    """
    shown = ascii(word if len(word) <= 40 else word[:40] + "...")
    if "\0" in word:
        raise UsageError(f"{shown} with a NUL in it", "a word without one", "correct it")
    try:
        os.fsencode(word).decode("utf-8")
    except UnicodeError:
        raise UsageError(f"{shown}, which is not UTF-8", "a name in UTF-8", "rename the file") from None
    if any("\ud800" <= letter <= "\udfff" for letter in word):  # bytes that Python could not decode
        raise UsageError(f"{shown} in a locale without such letters", "a locale of UTF-8", "set PYTHONUTF8=1")
    return word


def check_path(word: str) -> Path:
    """Return a path that the file system can hold."""
    check_word(word)
    if not word.strip():
        raise UsageError(repr(word), "the name of a file or folder", "write one")
    data = os.fsencode(word)
    if len(data) > PATH_BYTES_AT_MOST or max(map(len, data.split(b"/"))) > NAME_BYTES_AT_MOST:
        raise UsageError(
            f"{word[:40] + '...'!a}, a path of {len(data):,} bytes",
            f"at most {NAME_BYTES_AT_MOST} bytes a name and {PATH_BYTES_AT_MOST:,} in all",
            "choose a shorter one",
        )
    return Path(word)


def user_path(text: str, error: type[LidarGritError] = DataError) -> Path:
    """Return a path with ``~`` and ``~user`` replaced by home folders."""
    try:
        return check_path(text).expanduser()
    except RuntimeError:  # what pathlib raises
        raise error(f"{text}, in a home folder that is not there", "an existing user's", "check the path") from None
    except UsageError as why:
        raise error(why.got, why.wanted, why.cure) from None


@dataclass(frozen=True)
class Number:
    """A word → a number within bounds, neither NaN nor infinite; UsageError names the bounds."""

    at_least: float = 0.0
    at_most: float = NUMBER_AT_MOST
    _kind: ClassVar[str] = "a number"
    _form: ClassVar[str] = ",g"

    def __call__(self, word: str) -> float:
        """Return the number."""
        try:
            value = self._value(word)
        except ValueError:
            raise UsageError(repr(word[:40]), self._kind, "correct it") from None
        if not self.at_least <= value <= self.at_most:  # refuses NaN too
            bounds = f"{self.at_least:{self._form}} to {self.at_most:{self._form}}"
            raise UsageError(word[:40], f"{self._kind} from {bounds}", "correct it")
        return value

    def _value(self, word: str) -> float:
        return float(word)


@dataclass(frozen=True)
class WholeNumber(Number):
    """A word → a whole number within bounds, none of them below 0; UsageError names the bounds."""

    at_least: int = 0
    at_most: int = COUNT_AT_MOST
    _kind: ClassVar[str] = "a whole number"
    _form: ClassVar[str] = ","

    def __call__(self, word: str) -> int:
        """Return the number."""
        return int(super().__call__(word))

    def _value(self, word: str) -> int:
        return int(word) if len(word) <= 40 else -1  # Python needs quadratic time for long ones


whole_number, seed_number = WholeNumber(), WholeNumber(at_most=SEED_AT_MOST)
process_count, step_in_mm = WholeNumber(1, PROCESSES_AT_MOST), WholeNumber(1, STEP_MM_AT_MOST)


def seeds_in_a_row(first: int, count: int) -> range:
    """Return the seeds of a number of scans from a first one on, the next scan with the next seed."""
    if first + count - 1 > SEED_AT_MOST:
        got = f"--seed {first} with -n {count}, of which the last scan has the seed {first + count - 1}"
        raise UsageError(got, f"seeds up to {SEED_AT_MOST}", "lower one of the two")
    return range(first, first + count)


_JSON_NAMES: dict[type, str] = {
    dict: "an object",
    list: "a list",
    str: "a text",
    bool: "true or false",
    int: "a number",
    float: "a number",
    type(None): "null",
}


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name}, which is not JSON")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:40]}, which no float can hold")
    return value


def _whole(text: str) -> int:
    _finite(text)
    return int(text)


def _is_deep(value: Any) -> bool:
    """Return whether a value nests deeper than is allowed, level by level: recursion is what it protects from."""
    level = [value]
    for _ in range(JSON_DEPTH_AT_MOST + 1):
        level = [
            child
            for parent in level
            if isinstance(parent, (dict, list))
            for child in (parent.values() if isinstance(parent, dict) else parent)
            if isinstance(child, (dict, list))
        ]
        if not level:
            return False
    return True

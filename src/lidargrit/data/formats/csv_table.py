"""Tables of text (.csv) with a header that names x, y and z ⇄ :class:`Scan`."""

import codecs
import re
import warnings
from collections.abc import Mapping
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Num

from lidargrit.core.errors import ScanError, first_words
from lidargrit.core.files import atomic_path
from lidargrit.data.formats import POINTS_AT_MOST, BadPoints, first_bytes, read_bytes
from lidargrit.data.formats.shared.columns import (
    BYTES_AT_MOST,
    ColumnFormat,
    check_lines,
    in_one_word,
    plain_text,
    scan_of_columns,
)
from lidargrit.scans.columns import known_name
from lidargrit.scans.types import Scan

_AXES = {"x", "y", "z"}
_FORMAT = "lines of numbers below a line that names the columns, x, y and z among them"
_HEADER_BYTES = 4096
_WHOLE_BELOW = 2.0**63
_MARKS_OF_UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_SEPARATORS = (",", ";", "\t", " ")


class CsvTable(ColumnFormat):
    """Text with a first line of names, such as ``x,y,z,intensity``; separated by commas, semicolons, tabs or blanks.

    Names and numbers may stand in quotation marks, names in capitals, and "#" or "//" before the first of them. Numbers
    have a decimal point. Columns of other names go along where they hold numbers only; a note names the rest.
    """

    title = "table of text with a header (.csv)"
    suffixes = (".csv",)

    @staticmethod
    def recognises(path: Path) -> bool:
        """Return whether the first line names x, y and z."""
        return {name.lower() for name in _names(_utf_8(first_bytes(path, _HEADER_BYTES)))[0]} >= _AXES

    @staticmethod
    def read(path: Path, index: int = 0, bad_points: BadPoints = "refuse") -> Scan:
        """Read the scan in a file."""
        data = _utf_8(read_bytes(path, BYTES_AT_MOST, _FORMAT))
        names, separator = _names(data[:_HEADER_BYTES])
        named = {name: names.index(name) for name in names if name}  # of one name the first
        wanted = {name: number for name, number in named.items() if name.lower() in _AXES or known_name(name)}
        if not {name.lower() for name in wanted} >= _AXES:
            there = ", ".join(map(ascii, names[:8]))[:120] or "nothing"
            raise ScanError(
                f"{path}, whose first line names {there}", _FORMAT, "put a line such as x,y,z,intensity before the rest"
            )
        body = data[data.find(b"\n") + 1 :] if b"\n" in data else b""
        check_lines(body, path, _FORMAT)
        _check_fields(body, len(names), separator, path)
        body = _with_nan(_unquoted(plain_text(body), separator), len(names), separator)
        columns = _columns(body, named, wanted, separator, path)
        scan = scan_of_columns(columns, path, bad_points, names)
        words = [ascii(name) for name in named if name not in columns]
        if not words:
            return scan
        what = f"{'column' if len(words) == 1 else 'columns'} {', '.join(words[:3])} left out: not numbers in all lines"
        return replace(scan, notes=(*scan.notes, what))

    @classmethod
    def write_columns(cls, path: Path, columns: Mapping[str, np.ndarray]) -> None:
        """Write columns to a new file, numbers with as many digits as tell them from all others."""
        columns = in_one_word(columns)
        form = ["%d" if of.dtype.kind in "iub" else "%s" for of in columns.values()]
        # Not as doubles, which do not hold the nanoseconds of a clock.
        table = np.rec.fromarrays([*columns.values()], [(name, of.dtype) for name, of in columns.items()])
        with atomic_path(path) as temporary:
            np.savetxt(temporary, table, form, ",", header=",".join(columns), comments="", encoding="utf-8")


def _columns(
    body: bytes, named: dict[str, int], needed: dict[str, int], separator: str, path: Path
) -> dict[str, Num[np.ndarray, "n"]]:
    """Return the columns that hold numbers, or refuse a table in which one that is needed does not."""
    first = body.lstrip(b"\r\n").partition(b"\n")[0].decode("latin1")
    cells = first.split() if separator == " " else first.split(separator)
    others = [name for name in named if name not in needed and _is_number("".join(cells[named[name] :][:1]))]
    table = _table(body, [named[name] for name in [*needed, *others]], separator)
    if isinstance(table, Exception):  # a word in a later line of some column
        others = [name for name in others if not isinstance(_table(body, [named[name]], separator), Exception)]
        table = _table(body, [named[name] for name in [*needed, *others]], separator)
    if isinstance(table, Exception):
        what = f"{path}, whose lines cannot be read ({first_words(table)})"
        raise ScanError(what, _FORMAT, "give every line a number in each column, with a decimal point")
    if not 1 <= len(table) <= POINTS_AT_MOST:
        raise ScanError(f"{len(table):,} lines in {path}", f"1 to {POINTS_AT_MOST:,}", "give one revolution a file")
    read = dict(zip([*needed, *others], table.T, strict=True))
    in_order = [name for name in named if name in read]
    return {name: read[name] if name.lower() in _AXES else _whole(read[name]) for name in in_order}


def _whole(values: Float64[np.ndarray, "n"]) -> Num[np.ndarray, "n"]:
    """Return whole numbers as such, so that what is added to a column of them is whole, too."""
    if np.isfinite(values).all() and (np.abs(values) < _WHOLE_BELOW).all() and (values % 1 == 0).all():
        return values.astype(np.int64)
    return values


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _table(body: bytes, columns: list[int], separator: str) -> Float64[np.ndarray, "n k"] | Exception:
    """Return columns of numbers, or what the parser stumbled over."""
    try:
        with warnings.catch_warnings(action="ignore"):  # of a table without lines: its caller says it
            return np.loadtxt(
                BytesIO(body),
                np.float64,
                comments=None,
                delimiter=None if separator == " " else separator,
                usecols=columns,
                max_rows=POINTS_AT_MOST + 1,
                ndmin=2,
                encoding="latin1",
            )
    except Exception as error:  # whatever the text is
        return error


def _utf_8(data: bytes) -> bytes:
    """Return a table that Windows saved as UTF-16 ("Unicode") in UTF-8, and others as they are."""
    return data if data[:2] not in _MARKS_OF_UTF_16 else data.decode("utf-16", "replace").encode()


def _unquoted(body: bytes, separator: str) -> bytes:
    """Return lines without the quotation marks around a whole field, which spreadsheets write."""
    return re.sub(rb'"([^"\n' + separator.encode() + rb']*)"', rb"\1", body) if b'"' in body else body


def _with_nan(body: bytes, names: int, separator: str) -> bytes:
    """Return lines in which empty cells between separators are ``nan``, as tables of pandas mean them."""
    mark, lines = separator.encode(), body.count(b"\n") + 1
    if separator == " " or body.count(mark) > (names + 1) * lines:  # lines of separators would become far longer
        return body
    blank = rb"[ \r]*"
    first = re.sub(rb"(?m)^" + blank + rb"(?=" + mark + rb")", b"nan", body)
    return re.sub(rb"(?<=" + mark + rb")" + blank + rb"(?=" + mark + rb"|\n|\Z)", b"nan", first)


def _check_fields(body: bytes, at_most: int, separator: str, path: Path) -> None:
    """Refuse a line of more fields than there are names: which of them is x could not be told."""
    mark = separator.encode()
    for line in BytesIO(body):
        if separator == " ":
            fields = len(line.split())
        elif line.count(mark) < at_most:
            continue
        else:  # empty ones at the end name nothing, and some programs write one
            fields = line.rstrip(b"\r\n\t " + mark).count(mark) + 1
        if fields > at_most:
            what = f"a line of {fields} fields below {at_most} names in {path}"
            raise ScanError(what, _FORMAT, "name every column in the first line, and give no line more")


def _names(start: bytes) -> tuple[list[str], str]:
    line = start.partition(b"\n")[0].decode("latin1").removeprefix("\u00ef\u00bb\u00bf").strip()
    line = line.removeprefix("#").removeprefix("//").strip()  # numpy.savetxt and CloudCompare write them there
    separator = next((each for each in _SEPARATORS if each in line), ",")
    names = line.split() if separator == " " else line.split(separator)
    return [name.strip().strip("\"'").strip() for name in names], separator

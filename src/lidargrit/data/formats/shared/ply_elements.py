"""Rows of an element of a PLY file, lists among their properties → columns of the properties that are no list."""

from io import BytesIO
from typing import NamedTuple

import numpy as np


class Property(NamedTuple):
    """A property of each row of an element.

    Args:
        kind: numpy type of its value, or of each value of a list.
        count_kind: numpy type of the number of values of a list; "" for a single value.
    """

    name: str
    kind: str
    count_kind: str = ""


class Element(NamedTuple):
    """An element of a header."""

    name: str
    rows: int
    properties: list[Property]

    @property
    def has_lists(self) -> bool:
        """Whether rows may differ in size."""
        return any(one.count_kind for one in self.properties)

    def single(self) -> dict[str, int]:
        """Return the place of every property of one value; of two of one name, that of the first."""
        places: dict[str, int] = {}
        for at, one in enumerate(self.properties):
            if not one.count_kind:
                places.setdefault(one.name, at)
        return places


def binary_rows(data: bytes, start: int, element: Element, order: str) -> tuple[dict[str, np.ndarray], int]:
    """Return the columns of an element, and where it ends.

    Args:
        data: content of the whole file.
        start: position of its first row.
        element: element of the header.
        order: numpy's sign for the byte order.
    """
    if not element.rows:
        return {}, start
    kinds = [
        (np.dtype(order + one.kind), np.dtype(order + one.count_kind) if one.count_kind else None)
        for one in element.properties
    ]
    lengths = _lengths(data, start, kinds)
    fields = []
    for at, ((kind, count_kind), length) in enumerate(zip(kinds, lengths, strict=True)):
        if count_kind is None:
            fields.append((f"{at}", kind))
        else:
            fields += [(f"{at} count", count_kind), (f"{at}", kind, (length,))]
    row = np.dtype(fields)
    is_even = start + element.rows * row.itemsize <= len(data)
    if is_even:
        rows = np.frombuffer(data, row, element.rows, start)
        is_even = all((rows[f"{at} count"] == lengths[at]).all() for at, one in enumerate(kinds) if one[1] is not None)
        if is_even:
            columns = {name: rows[f"{at}"] for name, at in element.single().items()}
            return columns, start + element.rows * row.itemsize
    if not element.has_lists:
        raise ValueError(f"{len(data)} bytes instead of {start + element.rows * row.itemsize}")
    return _uneven_rows(data, start, element, kinds)


def text_columns(data: bytes, element: Element) -> dict[str, np.ndarray]:
    """Return the columns of an element with lists, of text in which each row is a line."""
    places = element.single()
    if 2 * element.rows * len(element.properties) > len(data) + 1:  # a number takes a digit and a blank
        raise ValueError(f"{len(data)} bytes of text, less than its rows need")
    found, row = np.empty((element.rows, len(places))), 0
    for line in filter(bytes.strip, BytesIO(data)):
        words = line.split()
        at, starts = 0, []
        try:
            for one in element.properties:
                starts.append(at)
                at += 1 + (int(words[at]) if one.count_kind else 0)
            found[row] = [float(words[starts[place]]) for place in places.values()]
        except (ValueError, IndexError):
            at = -1
        if at != len(words):
            raise ValueError(f"row {row}, which does not fit its header")
        row += 1
        if row == element.rows:
            return dict(zip(places, found.T, strict=True))
    raise ValueError(f"{row} rows instead of {element.rows}")


def _lengths(data: bytes, start: int, kinds: list[tuple[np.dtype, np.dtype | None]]) -> list[int]:
    lengths = []
    for kind, count_kind in kinds:
        length = 1
        if count_kind is not None:
            length = int(_value(data, start, count_kind))
            start += count_kind.itemsize
        start += length * kind.itemsize
        if length < 0 or start > len(data):
            raise ValueError(f"{len(data)} bytes, less than its rows need")
        lengths.append(length)
    return lengths


def _value(data: bytes, at: int, kind: np.dtype) -> int:
    if at + kind.itemsize > len(data):
        raise ValueError(f"{len(data)} bytes, less than its rows need")
    return int(np.frombuffer(data, kind, 1, at)[0])


def _uneven_rows(
    data: bytes, start: int, element: Element, kinds: list[tuple[np.dtype, np.dtype | None]]
) -> tuple[dict[str, np.ndarray], int]:
    places = element.single()
    wanted = {at: np.empty(element.rows, np.int64) for at in places.values()}
    for row in range(element.rows):
        for at, (kind, count_kind) in enumerate(kinds):
            if count_kind is None:
                if at in wanted:
                    wanted[at][row] = start
                start += kind.itemsize
                continue
            length = _value(data, start, count_kind)
            start += count_kind.itemsize + length * kind.itemsize
            if length < 0 or start > len(data):
                raise ValueError(f"{len(data)} bytes, less than its rows need")
        if start > len(data):
            raise ValueError(f"{len(data)} bytes, less than its rows need")
    every = np.frombuffer(data, np.uint8)
    columns = {}
    for name, at in places.items():
        kind = kinds[at][0]
        gathered = np.stack([every[wanted[at] + byte] for byte in range(kind.itemsize)], axis=1)
        columns[name] = np.ascontiguousarray(gathered).view(kind).reshape(-1)
    return columns, start

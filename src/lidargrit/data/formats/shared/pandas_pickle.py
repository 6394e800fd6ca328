"""Tables that pandas before 1.2 pickled: bytes → named columns, without pandas and without running what is in them.

Every class and function that a file names is replaced by a record of ours, or refused.
"""

import math
import pickle
import pickletools
from io import BytesIO
from typing import Any

import numpy as np

_OPCODES_AT_MOST = 10_000  # a table of six columns takes 230
_KINDS = {"f8", "f4", "i8", "i4", "i2", "i1", "u8", "u4", "u2", "u1"}
_NUMPY = ("numpy.core.multiarray", "numpy._core.multiarray")  # before NumPy 2, and since


class _Record:
    """What stands for an object of pandas: what it was made of, and its state."""

    state: Any = ()

    def __init__(self, *arguments: Any) -> None:
        self.arguments = arguments

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Array(_Record):
    """What stands for an array of NumPy."""

    def values(self) -> np.ndarray:
        """Return its numbers, checked against the bytes that are there."""
        _, shape, kind, is_fortran, data = self.state
        code = kind.arguments[0]
        order = kind.state[1]
        if code not in _KINDS or order not in {"<", "|"} or not isinstance(data, bytes):
            raise ValueError(f"an array of {code!r:.20}")
        if math.prod(shape) * int(code[1]) != len(data) or min(shape) < 0:
            raise ValueError(f"an array of {shape!r:.40} in {len(data)} bytes")
        return np.frombuffer(data, f"<{code}").reshape(shape, order="F" if is_fortran else "C")

    def names(self) -> list[str]:
        data = self.state[4]
        if not isinstance(data, list) or not all(isinstance(name, str) for name in data):
            raise ValueError("names of columns that are no text")
        return data


class _Nothing:
    """What stands for a class that is named and not called."""


_STANDINS: dict[tuple[str, str], object] = {
    **dict.fromkeys([(module, "_reconstruct") for module in _NUMPY], _Array),
    ("numpy", "ndarray"): _Nothing,
    ("numpy", "dtype"): _Record,
    ("pandas.core.frame", "DataFrame"): _Record,
    ("pandas.core.internals.managers", "BlockManager"): _Record,
    ("pandas.core.indexes.base", "_new_Index"): _Record,
    ("pandas.core.indexes.base", "Index"): _Nothing,
    ("pandas.core.indexes.range", "RangeIndex"): _Nothing,
    ("builtins", "slice"): slice,
}


class _Unpickler(pickle.Unpickler):
    def find_class(self, module_name: str, global_name: str, /) -> Any:
        """Return what stands for a class or function; refuse all that such tables do not need."""
        try:
            return _STANDINS[module_name, global_name]
        except KeyError:
            raise pickle.UnpicklingError(f"it asks for {module_name[:60]}.{global_name[:60]}") from None

    def persistent_load(self, pid: Any, /) -> Any:
        """Refuse objects that lie elsewhere."""
        raise pickle.UnpicklingError("it asks for an object that lies elsewhere")


def columns_of_table(data: bytes) -> dict[str, np.ndarray]:
    """Return the columns of numbers of a pickled table, by their names.

    Raises:
        Exception: of many kinds, for anything but such a table.
    """
    _check_opcodes(data)
    table = _Unpickler(BytesIO(data)).load()
    _, blocks, names, _ = table.state["_data"].state
    columns = dict[str, np.ndarray]()
    for block, of_block in zip(blocks, names, strict=True):
        columns |= zip(of_block.arguments[1]["data"].names(), block.values(), strict=True)
    if len({column.shape for column in columns.values()}) != 1 or next(iter(columns.values())).ndim != 1:
        raise ValueError("columns of several lengths")
    return columns


def _check_opcodes(data: bytes) -> None:
    """Refuse what makes the unpickler itself take much memory or time: many steps, or a place far up in its memory."""
    for count, (opcode, argument, _) in enumerate(pickletools.genops(data)):
        is_far = "PUT" in opcode.name and isinstance(argument, int) and argument > _OPCODES_AT_MOST
        if count > _OPCODES_AT_MOST or is_far:
            raise ValueError("more than a table of points takes")

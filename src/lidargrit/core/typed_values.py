"""A type, perhaps with bounds, and a value or a word → the value if it fits, or what would fit in words."""

import json
import math
import re
import sys
from dataclasses import dataclass
from numbers import Integral, Real
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from lidargrit.core.errors import ConfigError, one_of
from lidargrit.core.untrusted import TEMPERATURE_AT_LEAST, WHOLE_NUMBER_AT_MOST

_SHOWN_AT_MOST = 80  # letters of a value in a message
_ITEM = r"""(?:\s*'[^']*'\s*|\s*"(?:[^"\\]|\\.)*"\s*|[^,\[\]'"]*)"""
_LIST = re.compile(rf"\[({_ITEM}(?:,{_ITEM})*)\]")


@dataclass(frozen=True)
class Bounds:
    """Bounds of a number, or of how many values a tuple has, beside a type: ``Annotated[int, Bounds(1, 16)]``.

    Args:
        above: largest value that is too small.
        below: smallest value that is too large.
        multiple_of: divisor of whole numbers that fit.
        or_0: whether 0 fits besides.
    """

    least: int | float = -math.inf
    most: int | float = math.inf
    above: int | float = -math.inf
    below: int | float = math.inf
    multiple_of: int = 1
    or_0: bool = False

    def hold(self, value: Any) -> bool:
        """Return whether a number, or the length of a tuple, is within the bounds."""
        number = len(value) if isinstance(value, tuple) else value
        within = self.least <= number <= self.most and self.above < number < self.below
        return (self.or_0 and number == 0) or (within and (self.multiple_of == 1 or number % self.multiple_of == 0))

    def __str__(self) -> str:
        ends = (("at least", self.least), ("above", self.above), ("at most", self.most), ("below", self.below))
        said = [f"{word} {end:{',' if isinstance(end, int) else 'g'}}" for word, end in ends if math.isfinite(end)]
        said += [f"a multiple of {self.multiple_of}"] * (self.multiple_of > 1) + ["or 0"] * self.or_0
        return ", ".join(said)


NotNegative = Annotated[int, Bounds(0)]
Count = Annotated[int, Bounds(1)]
Weight = Annotated[float, Bounds(0)]
Positive = Annotated[float, Bounds(above=0)]
Share = Annotated[float, Bounds(0, 1)]
Temperature = Annotated[float, Bounds(TEMPERATURE_AT_LEAST, or_0=True)]
ShareBelow1 = Annotated[float, Bounds(0, below=1)]


def in_words(hint: Any) -> str:
    """Return what values of a type are, for a person.

    Example:
        >>> in_words(Annotated[tuple[Count, ...], Bounds(1, 16)] | None)
        'at least 1, at most 16 values, each a whole number, at least 1, or none'
    """
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        words = in_words(parts[0])
        return f"{parts[1]} {words}" if get_origin(parts[0]) is tuple else f"{words}, {parts[1]}"
    if origin is Literal:
        return one_of([str(choice) for choice in parts])
    if origin is tuple:
        return f"{'' if parts[-1] is ... else f'{len(parts)} '}values, each {in_words(parts[0])}"
    if type(None) in parts:
        return ", or ".join([*(in_words(part) for part in parts if part is not type(None)), "none"])
    usual = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}
    return usual.get(hint) or f"a value of the type {str(hint).replace('typing.', '')}"


def fits(hint: Any, value: Any) -> bool:
    """Return whether a value is of a type and within its bounds; numbers are finite, and whole ones take 64 bits."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return fits(parts[0], value) and parts[1].hold(value)
    if origin in (Union, UnionType):
        return any(fits(part, value) for part in parts)
    if origin is tuple:
        each = parts[:1] * len(value) if isinstance(value, tuple) and parts[-1] is ... else parts
        return isinstance(value, tuple) and len(value) == len(each) and all(map(fits, each, value))
    if origin is dict:
        return isinstance(value, dict) and all(fits(parts[1], each) for each in value.values())
    return value in parts if origin is Literal else hint is Any or _is_a(hint, value)


def _is_a(kind: type, value: Any) -> bool:
    if kind not in (int, float):
        return isinstance(value, kind)
    if isinstance(value, bool) or not isinstance(value, Integral if kind is int else Real):
        return False
    number: Any = value  # the abstract kinds of numbers do not tell that they are ordered
    return abs(number) <= (WHOLE_NUMBER_AT_MOST if kind is int else sys.float_info.max)  # infinity and NaN are not


def check(hint: Any, value: Any, name: str) -> None:
    """Refuse a value that does not fit its type, with one line that tells its name and what would fit."""
    if not fits(hint, value):
        raise _misfit(hint, repr(value), name)


def from_word(hint: Any, word: str, name: str) -> Any:
    """Return the value that a user wrote as a word; a tuple is ``a,b`` or ``[a, 'b, c']``, and None is ``null``."""
    value = None if word == "null" and fits(hint, None) else _parsed(bare(hint), word)
    if not fits(hint, value):
        raise _misfit(hint, word, name)
    return value


def bare(hint: Any) -> Any:
    """Return a type without its bounds, and without the choice of None."""
    while get_origin(hint) in (Annotated, Union, UnionType):
        hint = next(part for part in get_args(hint) if part is not type(None))
    return hint


def _misfit(hint: Any, text: str, name: str) -> ConfigError:
    shown = text if len(text) <= _SHOWN_AT_MOST else f"{text[:_SHOWN_AT_MOST]} [...]"
    return ConfigError(f"{name}={shown}", in_words(hint), "correct the value")


def _parsed(hint: Any, word: str) -> Any:
    """Return a word as a value of a type; where it cannot be one, the word itself, which then does not fit."""
    parts = get_args(hint)
    try:
        if get_origin(hint) is tuple:
            return tuple(_parsed(bare(parts[0]), item) for item in _items(word))
        if get_origin(hint) is Literal:
            return next((choice for choice in parts if str(choice) == word), word)
        if hint is bool:
            return {"true": True, "false": False}.get(word.lower(), word)
        return hint(word) if hint in (int, float) else word
    except ValueError:
        return word


def _items(word: str) -> list[str]:
    """Return the items of a tuple, or raise ValueError where brackets or quotation marks do not match."""
    if not word.startswith("["):
        return word.split(",")
    if (found := _LIST.fullmatch(word)) is None:
        raise ValueError(word)
    items = [item.strip() for item in re.findall(rf"(?:^|,)({_ITEM})", found[1])] if found[1].strip() else []
    return [json.loads(item) if item[:1] == '"' else item.strip("'") for item in items]

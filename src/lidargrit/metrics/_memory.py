"""Work that several metrics share → done once: the last results of a function, found again by what went in."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import numpy as np

Function = TypeVar("Function", bound=Callable[..., Any])


def remembered(at_most: int) -> Callable[[Function], Function]:
    """Keep the last ``at_most`` results of a function of arrays and plain values, for all who call it.

    A call is recognised by the bytes of its arrays, so that a change in place is never missed. Reading them takes a
    thousandth of what the functions here do with them. Results are shared: whoever gets one must not change it.
    """

    def decorate(function: Function) -> Function:
        results: OrderedDict[bytes, Any] = OrderedDict()

        @wraps(function)
        def call(*arguments: Any) -> Any:
            key = _digest(arguments)
            result = results.get(key)
            if result is None:
                result = results[key] = function(*arguments)
                while len(results) > at_most:
                    results.popitem(last=False)
            return result

        return call  # pyright: ignore[reportReturnType]

    return decorate


def _digest(arguments: tuple[Any, ...]) -> bytes:
    content = hashlib.blake2b(digest_size=16)
    for argument in arguments:
        if isinstance(argument, np.ndarray):
            content.update(repr((argument.shape, argument.dtype.str)).encode())
            content.update(argument.tobytes())
        else:
            content.update(repr(argument).encode())
    return content.digest()

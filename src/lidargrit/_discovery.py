"""The file name is the public name: a package's folder → the names in it, and the one object that a file defines."""

from __future__ import annotations

import ast
import importlib
import pkgutil
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from lidargrit.errors import UnknownNameError, nearest_names

T = TypeVar("T")


def names(package: str) -> list[str]:
    """List the public names of one of our folders, e.g. "datasets", without importing what they name."""
    return sorted(m.name for m in pkgutil.iter_modules([str(_folder(package))]) if not m.name.startswith("_"))


def summary(package: str, name: str) -> str:
    """Return the first line of a file's docstring, without importing it."""
    docstring = ast.get_docstring(ast.parse((_folder(package) / f"{name}.py").read_text(encoding="utf-8")))
    return (docstring or "").partition("\n")[0].replace("``", "")


def load_class(package: str, name: str, base: type[T]) -> type[T]:
    """Import the one subclass of ``base`` that the file ``package/name.py`` defines.

    Raises:
        UnknownNameError: no such file; names its nearest neighbours.
    """

    def own_subclass(value: object, module: str) -> type[T] | None:
        if isinstance(value, type) and issubclass(value, base) and value.__module__ == module:
            return value
        return None

    return _the_one(package, name, own_subclass)


def load_instance(package: str, name: str, base: type[T]) -> T:
    """Import the one object of type ``base`` that the file ``package/name.py`` defines.

    Raises:
        UnknownNameError: no such file; names its nearest neighbours.
    """
    return _the_one(package, name, lambda value, _: value if isinstance(value, base) else None)


def _folder(package: str) -> Path:
    folder = Path(__file__).parent.joinpath(*package.split("."))  # importlib would import the packages above it
    assert folder.is_dir(), package
    return folder


def _the_one(package: str, name: str, chosen: Callable[[object, str], T | None]) -> T:
    known = names(package)
    if name not in known:
        raise UnknownNameError(
            f"{name!r}, which is not among the {package}",
            f"one such as {nearest_names(name, known)}",
            f"see all with: lidargrit list {package}",
        )
    module = importlib.import_module(f"lidargrit.{package}.{name}")
    public = {id(value): value for key, value in vars(module).items() if not key.startswith("_")}
    found = [one for value in public.values() if (one := chosen(value, module.__name__)) is not None]
    assert len(found) == 1, f"{module.__name__} must define exactly one public object of its kind, has {len(found)}"
    return found[0]

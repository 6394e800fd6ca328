"""The file name is the public name: a kind, such as "datasets" → its names, and the object of each."""

from __future__ import annotations

import ast
import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Final, TypeVar

from lidargrit.core.errors import UnknownNameError, nearest_names

T = TypeVar("T")

FOLDERS: Final = {
    "datasets": "data/datasets",
    "formats": "data/formats",
    "sensors": "scans/sensors",
    "tokenizers": "generation/tokenizers",
    "generators": "systems",
    "conditions": "generation/conditions",
    "metrics": "evaluation/metrics",
    "protocols": "evaluation/protocols",
    "sample-formats": "data/sources/sample_formats",
    "recipes": "systems/*/presets",
    "cli": "cli",
}
"""Each kind as a user types it, and the folder whose files, or folders with a ``system.py``, are of this kind."""

_ROOT = Path(__file__).parents[1]


def names(kind: str) -> list[str]:
    """List the public names of a kind, e.g. "datasets", without importing what they name."""
    return sorted(_files(kind))


def summary(kind: str, name: str) -> str:
    """Return the first line of a file's docstring, without importing it."""
    path, _ = _files(kind)[name]
    docstring = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))
    return (docstring or "").partition("\n")[0].replace("``", "")


def load_class(kind: str, name: str, base: type[T]) -> type[T]:
    """Import the one subclass of ``base`` that the file of a name defines.

    Raises:
        UnknownNameError: no such file; names its nearest neighbours.
    """

    def own_subclass(value: object, module: str) -> type[T] | None:
        if isinstance(value, type) and issubclass(value, base) and value.__module__ == module:
            return value
        return None

    return _the_one(kind, name, own_subclass)


def load_instance(kind: str, name: str, base: type[T]) -> T:
    """Import the one object of type ``base`` that the file of a name defines.

    Raises:
        UnknownNameError: no such file; names its nearest neighbours.
    """
    return _the_one(kind, name, lambda value, _: value if isinstance(value, base) else None)


def _packages(kind: str) -> dict[str, Path]:
    """Return the packages that hold a kind, by their folders: importlib would import the packages above them."""
    found = {f"lidargrit.{'.'.join(path.relative_to(_ROOT).parts)}": path for path in _ROOT.glob(FOLDERS[kind])}
    assert found, kind
    return found


def _files(kind: str) -> dict[str, tuple[Path, str]]:
    """Return the file and the module of each name."""
    found = {}
    for package, folder in _packages(kind).items():
        found |= {path.stem: (path, f"{package}.{path.stem}") for path in folder.glob("[!_]*.py")}
        systems = [path.parent.name for path in folder.glob("[!_]*/system.py")]
        found |= {name: (folder / name / "system.py", f"{package}.{name}.system") for name in systems}
    return found


def _the_one(kind: str, name: str, chosen: Callable[[object, str], T | None]) -> T:
    known = names(kind)
    if name not in known:
        raise UnknownNameError(
            f"{name!r}, which is not among the {kind}",
            f"one such as {nearest_names(name, known)}",
            f"see all with: lidargrit list {kind}",
        )
    module = importlib.import_module(_files(kind)[name][1])
    public = {id(value): value for key, value in vars(module).items() if not key.startswith("_")}
    found = [one for value in public.values() if (one := chosen(value, module.__name__)) is not None]
    assert len(found) == 1, f"{module.__name__} must define exactly one public object of its kind, has {len(found)}"
    return found[0]

"""The file name is the public name: a kind, such as "datasets" → its names, and the object of each."""

import ast
import importlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Final, NamedTuple, TypeVar

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
    "presets": "systems/*",
    "cli": "cli",
}
"""Each kind as a user types it, and the folder whose files, or folders with a ``system.py``, are of this kind.

Presets are many in one file: the entries of the tables in ``systems/NAME/presets.py``.
"""

PRESETS, TO_COMPARE_WITH = "PRESETS", "TO_COMPARE_WITH"
"""Names of the tables in a ``presets.py``; the second holds what is there to be compared with."""

_ROOT = Path(__file__).parents[1]


class _Place(NamedTuple):
    """Where a name is defined.

    Args:
        table: table of the file that holds it; "" where the file holds nothing else.
    """

    path: Path
    module: str
    table: str = ""
    title: str = ""


def names(kind: str) -> list[str]:
    """List the public names of a kind, e.g. "datasets", without importing what they name."""
    return sorted(_places(kind))


def summary(kind: str, name: str) -> str:
    """Return the first line of a file's docstring, or the title of a preset, without importing it."""
    place = _places(kind)[name]
    if place.table:
        return place.title
    docstring = ast.get_docstring(ast.parse(place.path.read_text(encoding="utf-8")))
    return (docstring or "").partition("\n")[0].replace("``", "")


def table(kind: str, name: str) -> str:
    """Return the table that holds a preset; "" of other kinds."""
    return _places(kind)[name].table


def load_class(kind: str, name: str, base: type[T]) -> type[T]:
    """Import the one subclass of ``base`` that the file of a name defines."""

    def own_subclass(value: object, module: str) -> type[T] | None:
        if isinstance(value, type) and issubclass(value, base) and value.__module__ == module:
            return value
        return None

    return _the_one(kind, name, own_subclass)


def load_instance(kind: str, name: str, base: type[T]) -> T:
    """Import the object of type ``base`` that a table has under a name, or the one that the file of a name defines."""
    return _the_one(kind, name, lambda value, _: value if isinstance(value, base) else None)


@cache
def _packages(kind: str) -> dict[str, Path]:
    """Return the packages that hold a kind, by their folders: importlib would import the packages above them."""
    folders = [path for path in _ROOT.glob(FOLDERS[kind]) if path.is_dir()]
    assert folders, kind
    return {f"lidargrit.{'.'.join(path.relative_to(_ROOT).parts)}": path for path in folders}


def _places(kind: str) -> dict[str, _Place]:
    """Return where each name of a kind is defined."""
    of_presets = kind == "presets"
    return {name: place for at in _packages(kind).items() for name, place in _found_in(*at, of_presets).items()}


@cache  # a comparison asks hundreds of times, and the folders of the program stay as they are
def _found_in(package: str, folder: Path, of_presets: bool) -> dict[str, _Place]:
    if of_presets:
        file, module = folder / "presets.py", f"{package}.presets"
        entries = _entries(file) if file.is_file() else {}
        return {name: _Place(file, module, *entry) for name, entry in entries.items()}
    systems = [path.parent.name for path in folder.glob("[!_]*/system.py")]
    return {path.stem: _Place(path, f"{package}.{path.stem}") for path in folder.glob("[!_]*.py")} | {
        name: _Place(folder / name / "system.py", f"{package}.{name}.system") for name in systems
    }


def _entries(file: Path) -> dict[str, tuple[str, str]]:
    """Return the table and the title of each preset of a file, as they are written there.

    An entry is a call whose first argument is the title, or the name of such a call's result.
    """
    made: dict[str, ast.expr] = {}
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            made[node.targets[0].id] = node.value
    found = {}
    for table in (PRESETS, TO_COMPARE_WITH):
        entries = made.get(table, ast.Dict([], []))
        assert isinstance(entries, ast.Dict), f"{table} of {file} is not written as a table"
        for key, value in zip(entries.keys, entries.values, strict=True):
            call = made[value.id] if isinstance(value, ast.Name) else value
            assert isinstance(call, ast.Call), f"an entry of {table} of {file} is no call"
            assert key is not None
            found[ast.literal_eval(key)] = (table, ast.literal_eval(call.args[0]))
    return found


def _the_one(kind: str, name: str, chosen: Callable[[object, str], T | None]) -> T:
    if name not in names(kind):
        _found_in.cache_clear()  # its file may have been added since
    if name not in (known := names(kind)):
        raise UnknownNameError(
            f"{name!r}, which is not among the {kind}",
            f"one such as {nearest_names(name, known)}",
            f"see all with: lidargrit list {kind}",
        )
    place = _places(kind)[name]
    module = importlib.import_module(place.module)
    values = {name: getattr(module, place.table)[name]} if place.table else vars(module)
    public = {id(value): value for key, value in values.items() if not key.startswith("_")}
    found = [one for value in public.values() if (one := chosen(value, module.__name__)) is not None]
    assert len(found) == 1, f"{module.__name__} must define exactly one public object of its kind, has {len(found)}"
    return found[0]

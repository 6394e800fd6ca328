"""Frozen dataclasses ⇄ JSON, and single settings changed by name: ``training.tokenizer.batch_size=4``."""

import dataclasses
import functools
import json
from collections.abc import Collection, Iterable, Mapping
from typing import Any, ClassVar, TypeVar, cast, get_args, get_origin, get_type_hints

from lidargrit.core import discovery
from lidargrit.core.errors import ConfigError, nearest_names
from lidargrit.core.typed_values import bare, check, from_word

T = TypeVar("T")

COUNTS_SCANS = "counts_scans"
"""Key of a field's metadata: its number counts scans of the training, and falls with a smaller budget."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """Base of settings: a value that does not fit the type or the bounds of its field is refused.

    A class with further checks calls this one's ``__post_init__`` first.
    """

    def __post_init__(self) -> None:
        for name, hint in hints_of(type(self)).items():
            check(hint, getattr(self, name), name)


@dataclasses.dataclass(frozen=True)
class NamedConfig(Settings):
    """Base of configurations of which there are several kinds, each defined by one file of a folder of ours.

    Where a field's type is such a base, JSON says the kind under ``name``; without a name it is of the default kind,
    which is written without one.

    Attributes:
        package: the kind, as discovery knows it.
        default_name: file of the default kind.
    """

    package: ClassVar[str]
    default_name: ClassVar[str]

    @classmethod
    def name(cls) -> str:
        """Return the name of the file that defines the class."""
        return cls.__module__.rpartition(".")[2]


def to_json(config: Any) -> Any:
    """Return a configuration as plain JSON values (tuples become lists)."""
    return json.loads(json.dumps(_plain(config)))


def from_json(cls: type[T], data: Any, source: str) -> T:
    """Rebuild a configuration from :func:`to_json`, checking every type and every name.

    Raises:
        ConfigError: a value that does not fit, an unknown or a missing name; ``source`` names the file.
        UnknownNameError: a kind that there is not.
    """
    try:
        return rebuilt(cls, data)
    except (TypeError, ConfigError) as error:
        detail = f"{error.got}; wanted {error.wanted}" if isinstance(error, ConfigError) else str(error)
        raise ConfigError(
            f"a configuration in {source} that does not fit ({detail})",
            f"what this version writes for {cls.__name__}",
            "use the version that wrote it, or make the run anew",
        ) from None


def override(
    config: T,
    settings: Iterable[str],
    owner: str = "this preset",
    cure: str = "see all with --dry-run",
    fixed: Collection[str] = (),
) -> T:
    """Return the configuration with settings of the form ``a.b=value`` changed.

    A list needs no brackets: ``data.train=/data/one,/data/two``.

    Args:
        config: configuration to change; it stays as it is, and a changed copy is returned.
        settings: words of the form NAME=VALUE.
        owner: name of what has these settings, for a message.
        cure: hint on how to find the names of the settings, for a message.
        fixed: names of fields that are no settings.
    """
    known = {name: value for name, value in leaves(config).items() if name not in fixed}
    values: dict[str, Any] = {}
    for setting in settings:
        path, equals, text = setting.partition("=")
        if not equals:
            raise ConfigError(f"the setting {setting!r}", "NAME=VALUE", f"e.g. --set {next(iter(known), 'name')}=...")
        values[path.strip()] = text
    unknown = [path for path in values if path not in known]
    if unknown:
        raise ConfigError(
            f"the setting {unknown[0]!r}, which {owner} does not have",
            f"one such as {nearest_names(unknown[0], known)}" if known else "none, for it has no settings",
            cure,
        )
    return _replaced(config, "", values)


def changed(config: T, settings: Mapping[str, Any]) -> T:
    """Return a copy of a configuration with other values of settings, by their dotted names.

    All are changed at once, for a setting may be valid only together with another. A name may also be that of a part,
    such as ``model.transformer``, or of one that a mapping does not have yet, such as ``training.pixels``.
    """
    parts: dict[str, dict[str, Any]] = {}
    for path, value in settings.items():
        name, _, rest = path.partition(".")
        parts.setdefault(name, {})[rest] = value
    known = _children(config)
    new = {name: each[""] if "" in each else changed(known[name], each) for name, each in parts.items()}
    return cast(T, {**known, **new}) if isinstance(config, dict) else dataclasses.replace(cast(Any, config), **new)


def name_and_settings(word: str) -> tuple[str, list[str]]:
    """Split ``NAME:SETTING=VALUE,...`` into the name, which may hold colons, and its settings; a bare name has none.

    Example:
        >>> name_and_settings("runs/12:30:steps=32,eta=0.5")
        ('runs/12:30', ['steps=32', 'eta=0.5'])
        >>> name_and_settings("runs/12:30")
        ('runs/12:30', [])
    """
    name, colon, settings = word.rpartition(":")
    return (name, settings.split(",")) if colon and "=" in settings else (word, [])


def leaves(config: Any, prefix: str = "") -> dict[str, Any]:
    """Return every setting of a configuration, or of its JSON, by its dotted name."""
    found: dict[str, Any] = {}
    for name, value in _children(config).items():
        nested = dataclasses.is_dataclass(value) or isinstance(value, dict)
        path = f"{prefix}{name}"
        found |= leaves(value, f"{path}.") if nested else {path: value}
    return found


def own_first(settings: Any) -> dict[str, Any]:
    """Return settings by name, those of their own class before the ones that it shares with others."""
    names = [field.name for field in dataclasses.fields(settings)]
    names.sort(key=lambda name: name not in type(settings).__annotations__)
    return {name: getattr(settings, name) for name in names}


def _replaced(node: Any, prefix: str, values: dict[str, Any]) -> Any:
    """Change all settings below a node at once, for a setting may be valid only together with another."""
    changed: dict[str, Any] = {}
    for key, child in _children(node).items():
        path = prefix + key
        if path in values:
            changed[key] = from_word(hints_of(type(node))[key], values[path], path)
        elif any(name.startswith(f"{path}.") for name in values):
            changed[key] = _replaced(child, f"{path}.", values)
    return {**node, **changed} if isinstance(node, dict) else dataclasses.replace(node, **changed)


def _plain(node: Any) -> Any:
    if dataclasses.is_dataclass(node):
        settings = {key: _plain(value) for key, value in _children(node).items()}
        return settings if _kind(node) == "" else {"name": _kind(node), **settings}
    if isinstance(node, dict):
        return {key: _plain(value) for key, value in node.items()}
    return [_plain(value) for value in node] if isinstance(node, tuple | list) else node


def _kind(node: Any) -> str:
    """Return the ``name`` of a configuration in JSON; "" for the default kind."""
    return node.name() if isinstance(node, NamedConfig) and node.name() != node.default_name else ""


def rebuilt(hint: Any, data: Any, name: str = "") -> Any:
    """Return JSON as a value of a type, such as a dataclass; lists become tuples.

    Raises:
        ConfigError: a value of another type or out of its bounds; tells its name.
        TypeError: a name that is unknown or missing, or no names at all where a dataclass is to stand.
    """
    kind = bare(hint)
    if isinstance(kind, type) and dataclasses.is_dataclass(kind) and not (data is None and kind is not hint):
        if not isinstance(data, dict):
            raise TypeError(f"{str(data)[:40]!r} in place of settings by name{name and f' for {name!r}'}")
        if issubclass(kind, NamedConfig):
            data = {**data}
            kind = discovery.load_class(kind.package, str(data.pop("name", kind.default_name)), kind)
        hints = hints_of(kind)
        if unknown := sorted(data.keys() - hints):
            raise TypeError(f"no setting is called {unknown[0]!r}")
        return kind(**{key: rebuilt(hints[key], each, key) for key, each in data.items()})
    if get_origin(kind) is tuple and isinstance(data, list):
        data = tuple(rebuilt(get_args(kind)[0], each, name) for each in data)
    if get_origin(kind) is dict and isinstance(data, dict):
        return {key: rebuilt(get_args(kind)[1], each, key) for key, each in data.items()}
    check(hint, data, name)
    return float(data) if kind is float and isinstance(data, int) else data


@functools.cache
def hints_of(cls: type) -> dict[str, Any]:
    """Return the type of each field of a dataclass, with its bounds."""
    hints = get_type_hints(cls, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls)}


def _children(node: Any) -> dict[str, Any]:
    if isinstance(node, dict):
        return node
    if dataclasses.is_dataclass(node):
        return {field.name: getattr(node, field.name) for field in dataclasses.fields(node)}
    return {}

"""Frozen dataclasses ⇄ JSON, and single settings changed by name: ``training.tokenizer.batch_size=4``."""

import dataclasses
import json
import math
import re
from collections.abc import Collection, Iterable, Mapping
from numbers import Integral, Real
from typing import Any, ClassVar, Literal, TypeVar, cast, get_args, get_origin, get_type_hints

from lidargrit.core import discovery
from lidargrit.core.errors import ConfigError, UnknownNameError, nearest_names, one_of
from lidargrit.core.untrusted import WHOLE_NUMBER_AT_MOST

T = TypeVar("T")

COUNTS_SCANS = "counts_scans"
"""Key of a field's metadata: its number counts scans of the training, and falls with a smaller budget."""

_VALUES_AT_MOST = 1000  # of one setting; the parser takes a second for ten thousand
_LETTERS_AT_MOST = 100_000  # of one value on the command line: a list of as many long paths
_OTHER_BASES = re.compile(r":|(^|[\[,\s])[-+]?0\d")  # YAML 1.1 reads 1:30 as 90, and 010 in a list as 8


@dataclasses.dataclass(frozen=True)
class NamedConfig:
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


@dataclasses.dataclass(frozen=True)
class TypedSettings:
    """Base of settings that users also make in Python, where no parser looks at their types.

    A class with further checks calls this one's ``__post_init__`` first.
    """

    def __post_init__(self) -> None:
        hints = get_type_hints(type(self))
        for name, value in _children(self).items():
            if not _fits(value, hints[name]):
                raise ConfigError(f"{name}={value!r}", _in_words(hints[name]), "correct the value")


def to_json(config: Any) -> Any:
    """Return a configuration as plain JSON values (tuples become lists)."""
    return json.loads(json.dumps(_plain(config)))


def from_json(cls: type[T], data: Any, source: str) -> T:
    """Rebuild a configuration from :func:`to_json`, checking every type and every name.

    Raises:
        ConfigError: a value of another type, an unknown or a missing name; ``source`` names the file.
        UnknownNameError: a kind that there is not.
    """
    try:
        _check_nested(cls, data)
        for name, value in leaves(data).items():
            if isinstance(value, list) and len(value) > _VALUES_AT_MOST:
                raise TypeError(f"more than {_VALUES_AT_MOST:,} values for {name[:40]!r}")
        concrete, data = _concrete(cls, data)
        parser = _parser()
        parser.add_argument("--config", type=concrete)
        made = parser.instantiate(parser.parse_object({"config": data})).config
        for name, value in leaves(made).items():
            _check_numbers(value, f"{source}, in which {name} stands")
        return made if concrete is cls else cls(**_children(made))
    except (Exception, SystemExit) as error:  # the parser raises many kinds, for one cause: the file is not a cls
        if isinstance(error, ConfigError | UnknownNameError):
            raise
        raise ConfigError(
            f"a configuration in {source} that does not fit ({_first_line(error)})",
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

    Values are read as YAML. A list needs no brackets: ``data.train=/data/one,/data/two``.

    Args:
        config: configuration to change; it stays as it is, and a changed copy is returned.
        settings: words of the form NAME=VALUE.
        owner: name of what has these settings, for a message.
        cure: hint on how to find the names of the settings, for a message.
        fixed: names of fields that are no settings.

    Raises:
        ConfigError: an unknown name (names its nearest neighbours) or a value of another type.
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


def _replaced(node: Any, prefix: str, values: dict[str, Any]) -> Any:
    """Change all settings below a node at once, for a setting may be valid only together with another."""
    changed: dict[str, Any] = {}
    for key, child in _children(node).items():
        path = prefix + key
        if path in values:
            changed[key] = _parsed(get_type_hints(type(node))[key], path, values[path])
        elif any(name.startswith(f"{path}.") for name in values):
            changed[key] = _replaced(child, f"{path}.", values)
    return {**node, **changed} if isinstance(node, dict) else dataclasses.replace(node, **changed)


def _in_words(hint: Any) -> str:
    """Return what a value of a type is, for a person."""
    if get_origin(hint) is Literal:
        return one_of([str(choice) for choice in get_args(hint)])
    if type(None) in get_args(hint):
        others = [_in_words(part) for part in get_args(hint) if part is not type(None)]
        return one_of([*others, "none"])
    usual = {int: "a whole number", float: "a number", bool: "true or false"}
    return usual.get(hint) or f"a value of the type {str(hint).replace('typing.', '')}"


def _fits(value: object, hint: Any) -> bool:
    """Return whether a value is of a type: one of its choices, a number, text, or one of several such types."""
    if get_origin(hint) is Literal:
        return value in get_args(hint)
    if hint in (int, float):
        return isinstance(value, Integral if hint is int else Real) and not isinstance(value, bool)
    if isinstance(hint, type):
        return isinstance(value, hint)
    return any(_fits(value, part) for part in get_args(hint))


def _parsed(hint: Any, path: str, text: str) -> Any:
    if len(text) > _LETTERS_AT_MOST or text.count(",") >= _VALUES_AT_MOST:
        raise ConfigError(
            f"{path}={text}", f"at most {_VALUES_AT_MOST:,} values and {_LETTERS_AT_MOST:,} letters", "shorten it"
        )
    if hint == tuple[str, ...] and not text.startswith("["):
        return tuple(text.split(","))
    if _is_numeric(hint) and _OTHER_BASES.search(text):
        raise ConfigError(f"{path}={text}", _in_words(hint), "correct the value")
    if get_origin(hint) is tuple and not text.startswith("["):
        text = f"[{text}]"
    parser = _parser()
    parser.add_argument("--value", type=hint)
    try:
        value = parser.instantiate(parser.parse_args([f"--value={text}"])).value
    except (Exception, SystemExit):  # see from_json
        raise ConfigError(f"{path}={text}", _in_words(hint), "correct the value") from None
    _check_numbers(value, path)
    return tuple(value) if isinstance(value, list) else value


def _is_numeric(hint: Any) -> bool:
    parts = [part for part in get_args(hint) if part not in (type(None), Ellipsis)]
    return hint in (int, float) or (get_origin(hint) is not Literal and bool(parts) and all(map(_is_numeric, parts)))


def _check_numbers(value: Any, where: str) -> None:
    """Refuse whole numbers that take more than 64 bits, and numbers that are NaN or infinite."""
    if isinstance(value, (list, tuple)):
        for each in value:
            _check_numbers(each, where)
    elif isinstance(value, int) and abs(value) > WHOLE_NUMBER_AT_MOST:
        raise ConfigError(f"{where} with a number of {value.bit_length()} bits", "at most 63", "lower it")
    elif isinstance(value, float) and not math.isfinite(value):
        raise ConfigError(f"{where}={value}", "a finite number", "correct it")


def _parser() -> Any:
    from jsonargparse import ArgumentParser  # noqa: PLC0415  only presets need it, and --help should be quick

    return ArgumentParser(exit_on_error=False)


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


def _concrete(cls: type, data: dict[str, Any]) -> tuple[type, dict[str, Any]]:
    """Return a class like ``cls`` whose fields are of the kinds that the data name, and the data without those names.

    The parser knows the types of fields from the class alone.
    """
    kinds: dict[str, type] = {}
    for key, hint in get_type_hints(cls).items():
        if isinstance(hint, type) and issubclass(hint, NamedConfig):
            settings = {**data[key]} if key in data else _default_of(cls, key)
            kinds[key] = discovery.load_class(hint.package, str(settings.pop("name", hint.default_name)), hint)
            data = {**data, key: settings}
    if not kinds:
        return cls, data
    fields = [(key, kind, dataclasses.field(default_factory=kind)) for key, kind in kinds.items()]
    return dataclasses.make_dataclass(cls.__name__, fields, bases=(cls,), frozen=True), data


def _default_of(cls: type, key: str) -> dict[str, Any]:
    """Return the default of a field as JSON; {}, which is the default kind, of a field without one."""
    field = cls.__dataclass_fields__[key]
    if field.default_factory is not dataclasses.MISSING:
        return _plain(field.default_factory())
    return {} if field.default is dataclasses.MISSING else _plain(field.default)


def _check_nested(cls: type, data: Any, place: str = "") -> None:
    """Refuse anything but settings by name where a configuration is to stand, down to the last, with TypeError.

    The parser would take the defaults, or fail with words about its own insides.
    """
    if not isinstance(data, dict):
        raise TypeError(f"{str(data)[:40]!r} in place of settings by name{place}")
    for key, hint in get_type_hints(cls).items():
        if key in data and isinstance(hint, type) and dataclasses.is_dataclass(hint):
            _check_nested(hint, data[key], f" for {key!r}")


def _children(node: Any) -> dict[str, Any]:
    if isinstance(node, dict):
        return node
    if dataclasses.is_dataclass(node):
        return {field.name: getattr(node, field.name) for field in dataclasses.fields(node)}
    return {}


def _first_line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return " ".join(lines[:2])[:200]

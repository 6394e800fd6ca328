"""Frozen dataclasses ⇄ JSON, and single settings changed by name: ``training.tokenizer.batch_size=4``."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable
from typing import Any, TypeVar, get_type_hints

from lidargrit.errors import ConfigError, nearest_names

T = TypeVar("T")


def to_json(config: Any) -> Any:
    """Return a configuration as plain JSON values (tuples become lists)."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def from_json(cls: type[T], data: Any, source: str) -> T:
    """Rebuild a configuration from :func:`to_json`, checking every type and every name.

    Raises:
        ConfigError: a value of another type, an unknown or a missing name; ``source`` names the file.
    """
    parser = _parser()
    parser.add_argument("--config", type=cls)
    try:
        if not isinstance(data, dict):  # the parser would take the defaults
            raise TypeError(f"{str(data)[:40]!r} in place of settings by name")
        return parser.instantiate(parser.parse_object({"config": data})).config
    except (Exception, SystemExit) as error:  # the parser raises many kinds, for one cause: the file is not a cls
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(
            f"a configuration in {source} that does not fit ({_first_line(error)})",
            f"what this version writes for {cls.__name__}",
            "use the version that wrote it, or make the run anew",
        ) from None


def override(config: T, settings: Iterable[str]) -> T:
    """Return the configuration with settings of the form ``a.b=value`` changed.

    A value is read as YAML. Words for a list need no brackets: ``data.train=/data/one,/data/two``.

    Raises:
        ConfigError: an unknown name (names its nearest neighbours) or a value of another type.
    """
    for setting in settings:
        path, equals, text = setting.partition("=")
        if not equals:
            raise ConfigError(f"the setting {setting!r}", "NAME=VALUE", f"e.g. --set {next(iter(leaves(config)))}=...")
        config = _replaced(config, path.strip(), path.strip().split("."), text, config)
    return config


def leaves(config: Any, prefix: str = "") -> dict[str, Any]:
    """Return every setting of a configuration by its dotted name."""
    found: dict[str, Any] = {}
    for name, value in _children(config).items():
        nested = dataclasses.is_dataclass(value) or isinstance(value, dict)
        found |= leaves(value, f"{prefix}{name}.") if nested else {f"{prefix}{name}": value}
    return found


def _replaced(node: Any, path: str, keys: list[str], text: str, whole: Any) -> Any:
    children = _children(node)
    if keys[0] not in children or (len(keys) == 1 and _children(children[keys[0]])):
        raise ConfigError(
            f"the setting {path!r}, which this recipe does not have",
            f"one such as {nearest_names(path, leaves(whole))}",
            "see all with --dry-run",
        )
    if len(keys) > 1:
        value = _replaced(children[keys[0]], path, keys[1:], text, whole)
    else:
        value = _parsed(get_type_hints(type(node))[keys[0]], path, text)
    return {**node, keys[0]: value} if isinstance(node, dict) else dataclasses.replace(node, **{keys[0]: value})


def _parsed(hint: Any, path: str, text: str) -> Any:
    if hint == tuple[str, ...] and not text.startswith("["):
        return tuple(text.split(","))
    parser = _parser()
    parser.add_argument("--value", type=hint)
    try:
        value = parser.instantiate(parser.parse_args([f"--value={text}"])).value
    except (Exception, SystemExit):  # see from_json
        name = hint.__name__ if isinstance(hint, type) else str(hint).replace("typing.", "")
        raise ConfigError(f"{path}={text}", f"a value of the type {name}", "correct the value") from None
    return tuple(value) if isinstance(value, list) else value


def _parser() -> Any:
    from jsonargparse import ArgumentParser  # noqa: PLC0415  only recipes need it, and --help should be quick

    return ArgumentParser(exit_on_error=False)


def _children(node: Any) -> dict[str, Any]:
    if isinstance(node, dict):
        return node
    if dataclasses.is_dataclass(node):
        return {field.name: getattr(node, field.name) for field in dataclasses.fields(node)}
    return {}


def _first_line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return " ".join(lines[:2])[:200]

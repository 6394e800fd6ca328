"""A stranger's words → what is to be drawn, every value checked; and what there is to choose of a generator."""

from __future__ import annotations

import dataclasses
import inspect
import json
import math
import re
from dataclasses import dataclass, field
from typing import Any, get_type_hints

from lidargrit.errors import ConfigError, nearest_names
from lidargrit.serving.limits import Limits

SEED_AT_MOST = 2**32 - 1  # what fits a field on a page; more seeds than anyone will try
HIDDEN = {  # what of an uploaded scan the model does not get to see → how the page says it
    "nothing": "nothing: fill in the rays that have no point",
    "ahead": "the quarter straight ahead",
    "rows": "three of every four rows",
}
_WHOLE_AT_MOST = 1024  # steps and the like: four times what any published sampler takes
_FRACTION_AT_MOST = 100.0  # temperatures and the like: far beyond, everything is noise


@dataclass(frozen=True)
class SamplingSetting:
    """A number that a generator lets one choose when it draws.

    Args:
        name: of the field of its ``Sampling``.
        whole: whether it is a whole number.
        default: None where the generator chooses by itself.
        at_most: here.
        about: what the field's docstring says.
    """

    name: str
    whole: bool
    default: int | float | None
    at_most: int | float
    about: str


@dataclass(frozen=True)
class SampleRequest:
    """What somebody wants drawn.

    Args:
        model: its place among those that are served.
        seed: of the first scan.
        count: of scans.
        sampling: numbers by name that are not left as they are.
        hidden: of an uploaded scan; see :data:`HIDDEN`.
        file: where an uploaded scan lies; "" if there is none.
        name: that it was given, for people.
    """

    model: int
    seed: int = 0
    count: int = 1
    sampling: dict[str, int | float] = field(default_factory=dict)
    hidden: str = "nothing"
    file: str = ""
    name: str = ""


def sampling_settings(sampling: Any) -> list[SamplingSetting]:
    """Return the numbers among the fields of a generator's ``Sampling``."""
    hints = get_type_hints(type(sampling))
    found = []
    for one in dataclasses.fields(sampling):
        kind, default = hints[one.name], getattr(sampling, one.name)
        if kind not in (int, float, int | None, float | None):
            continue
        whole = kind in (int, int | None)
        at_most = max(_WHOLE_AT_MOST if whole else _FRACTION_AT_MOST, default or 0)
        found.append(SamplingSetting(one.name, whole, default, at_most, _about(type(sampling), one.name)))
    return found


def _about(sampling: type, name: str) -> str:
    """Return what a class's docstring says of a field, in one line."""
    text = inspect.cleandoc(sampling.__doc__ or "")
    said = re.search(rf"^    {name}: (.*?)(?=^    \w+: |^\S|\Z)", text, re.MULTILINE | re.DOTALL)
    return " ".join(said[1].split()).replace("``", "") if said else ""


def parse_json_object(data: bytes) -> dict[str, Any]:
    """Read JSON of an object.

    Raises:
        ConfigError: it is something else.
    """
    try:
        words = json.loads(data.decode("utf-8"), parse_constant=_refuse)
    except (ValueError, RecursionError):
        words = None
    if not isinstance(words, dict):
        raise ConfigError("words that are no JSON object", '{"model": 0, "seed": 0, ...}', "use the page")
    return words


def parse_request(words: dict[str, Any], settings: list[list[SamplingSetting]], limits: Limits) -> SampleRequest:
    """Check every word of a request.

    Args:
        words: by name; what is not said has its default.
        settings: of each model that is served.
        limits: what may be asked for.

    Raises:
        ConfigError: an unknown name, a value of another type, or one out of its bounds.
    """
    known = ("model", "seed", "count", "sampling", "hidden", "name")
    for name in words:
        if name not in known:
            raise ConfigError(f"the word {name[:40]!r}", f"one of {', '.join(known)}", "use the page")
    model = _whole("model", words.get("model", 0), 0, len(settings) - 1)
    hidden = words.get("hidden", "nothing")
    if not isinstance(hidden, str) or hidden not in HIDDEN:
        raise ConfigError(f"hidden={str(hidden)[:40]!r}", f"one of {', '.join(HIDDEN)}", "choose one")
    asked = words.get("sampling", {})
    if not isinstance(asked, dict):
        raise ConfigError("sampling that is no JSON object", "numbers by name", "use the page")
    of_name = {setting.name: setting for setting in settings[model]}
    for name in asked:
        if name not in of_name:
            wanted = f"one such as {nearest_names(name[:40], of_name)}" if of_name else "none: it has no such settings"
            raise ConfigError(f"the setting {name[:40]!r}, which this model does not have", wanted, "use the page")
    return SampleRequest(
        model,
        _whole("seed", words.get("seed", 0), 0, SEED_AT_MOST),
        _whole("count", words.get("count", 1), 1, limits.scans),
        {name: _number(of_name[name], value) for name, value in asked.items()},
        hidden,
        name=_plain(words.get("name", "")),
    )


def _refuse(word: str) -> None:
    raise ValueError(word)  # NaN and Infinity, which JSON does not have


def _whole(name: str, value: Any, at_least: int, at_most: int) -> int:
    if type(value) is not int or not at_least <= value <= at_most:  # nor a bool, which is an int to Python
        raise ConfigError(f"{name}={str(value)[:40]}", f"a whole number from {at_least} to {at_most}", "correct it")
    return value


def _number(setting: SamplingSetting, value: Any) -> int | float:
    if setting.whole:
        return _whole(setting.name, value, 0, int(setting.at_most))
    if type(value) not in (int, float) or not (abs(value) <= setting.at_most and math.isfinite(value)):
        raise ConfigError(f"{setting.name}={str(value)[:40]}", f"a number up to {setting.at_most:g}", "correct it")
    return float(value)


def _plain(name: Any) -> str:
    """Return the letters of a file's name that can do no harm anywhere, without any folder."""
    last = re.split(r"[/\\]", name if isinstance(name, str) else "")[-1]
    return re.sub(r"[^\w.()+-]", "_", last)[-60:]

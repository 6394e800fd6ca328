"""A client's JSON → a request whose every value is checked; and the numbers of a generator that a client may set."""

import inspect
import re
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_type_hints

from lidargrit.core.configuration import own_first
from lidargrit.core.discovery import names
from lidargrit.core.errors import CheckpointError, ConfigError, nearest_names
from lidargrit.core.typed_values import Bounds, Share, check, fits
from lidargrit.core.untrusted import SEED_AT_MOST, parse_json
from lidargrit.data import formats

UPSAMPLED = {"vlp16": "a VLP-16", "hdl32e": "an HDL-32E", "vlp32c": "a VLP-32C"}  # sensors with few rows
TASKS = {  # what a model makes of a scan → the words of its button on the page
    "ahead": "Fill the quarter ahead",
    "region": "Fill a region that you draw",
    "returns": "Fill rays without a point",
    "rows": "Fill three rows of four",
    **{sensor: f"Add the rows that {name} lacks" for sensor, name in UPSAMPLED.items()},
    "raydrop": "Drop rays of a clean scan",
    "label": "Name the class of each point",
}


@dataclass(frozen=True)
class Limits:
    """Bounds on size, time and number.

    Args:
        upload_bytes: largest uploaded file; a revolution of 128 rows by 2048 columns takes 12.6 MB as Ouster's PCD.
        request_bytes: longest JSON of a request.
        scans: largest number of scans in one request.
        seconds: longest time that one job may compute; the worker process is ended when it is over.
        start_seconds: longest time that the worker process may take to read the runs.
        waiting: largest number of jobs in the queue; a further client is asked to try again.
        unpolled_seconds: time after which a waiting job is dropped if its client no longer asks for it. Browsers let a
            hidden tab ask once a minute.
        kept: number of finished results that are kept; the oldest is removed first.
        connections: largest number of open connections, each of which holds at most one upload in memory.
        idle_seconds: time after which a connection is closed if no byte arrives on it.
    """

    upload_bytes: int = 16 << 20
    request_bytes: int = 4096
    scans: int = 8
    seconds: float = 120.0
    start_seconds: float = 300.0
    waiting: int = 8
    unpolled_seconds: float = 150.0
    kept: int = 24
    connections: int = 64
    idle_seconds: int = 15


LIMITS = Limits()


class Example(NamedTuple):
    """A simulated street to try a task on.

    Args:
        sensor: name of the sensor that sees it; "" for that of the model.
    """

    words: str
    task: str
    sensor: str = ""
    every_beam_returns: bool = False


EXAMPLES = {
    "street": Example("A street", "ahead"),
    "vlp16": Example("16 rows of a VLP-16", "vlp16", sensor="vlp16"),
    "clean": Example("A street without raydrop", "raydrop", every_beam_returns=True),
}
_WHOLE_AT_MOST = 1024  # steps and the like: four times what any published sampler takes
_FRACTION_AT_MOST = 100.0  # temperatures and the like: far beyond, everything is noise


@dataclass(frozen=True)
class SamplingSetting:
    """A number that a client may set when a generator samples.

    Args:
        default: default value; None where the generator computes one itself.
        about: description, from the docstring of ``Sampling``.
    """

    name: str
    whole: bool
    default: int | float | None
    at_most: int | float
    about: str


@dataclass(frozen=True)
class SampleRequest:
    """What a client asks for: new scans, or what a model makes of a scan that is uploaded or an example.

    Args:
        model: index of the model among those that are served.
        seed: seed of the first scan; the next scan has the next seed.
        sampling: values of the sampling settings that the client changed, by name.
        task: name of the work on the scan, a key of :data:`TASKS`.
        region: left, top, right and bottom edge of the region that is to be filled in, as shares of the image's width
            and height; empty if none was drawn.
        file: path of the uploaded scan; "" if there is none.
        example: name of the example in place of an uploaded scan, a key of :data:`EXAMPLES`; "" if there is none.
        name: name of the uploaded file on the client's side, for display.
    """

    model: int
    seed: int = 0
    count: int = 1
    sampling: dict[str, int | float] = field(default_factory=dict)
    task: str = "returns"
    region: tuple[float, ...] = ()
    file: str = ""
    example: str = ""
    name: str = ""

    @property
    def has_scan(self) -> bool:
        """Return whether there is a scan that the model works on."""
        return bool(self.file or self.example)


def sampling_settings(sampling: Any) -> list[SamplingSetting]:
    """Return the numbers among the fields of a generator's ``Sampling``."""
    hints = get_type_hints(type(sampling))
    found = []
    for name, default in own_first(sampling).items():
        kind = hints[name]
        if name == "batch_size" or kind not in (int, float, int | None, float | None):
            continue  # a client does not choose how much memory a batch takes
        whole = kind in (int, int | None)
        at_most = max(_WHOLE_AT_MOST if whole else _FRACTION_AT_MOST, default or 0)
        found.append(SamplingSetting(name, whole, default, at_most, _about(type(sampling), name)))
    return found


def parse_json_object(data: bytes) -> dict[str, Any]:
    """Parse the JSON object of a request."""
    try:
        return parse_json(data, "a request")
    except CheckpointError:
        raise ConfigError(
            "a request that is not a JSON object", '{"model": 0, "seed": 0, ...}', "use the page"
        ) from None


def parse_request(values: dict[str, Any], settings: list[list[SamplingSetting]], limits: Limits) -> SampleRequest:
    """Check every value of a request.

    Args:
        settings: sampling settings of each model that is served.
    """
    known = ("model", "seed", "count", "sampling", "task", "region", "example", "name")
    for name in values:
        if name not in known:
            raise ConfigError(f"the word {name[:40]!r}", f"one of {', '.join(known)}", "use the page")
    model = _whole("model", values.get("model", 0), 0, len(settings) - 1)
    task = _key("task", values.get("task", "returns"), TASKS)
    example = _key("example", values.get("example", ""), ("", *EXAMPLES))
    changed = values.get("sampling", {})
    if not isinstance(changed, dict):
        raise ConfigError("sampling that is not a JSON object", "numbers by name", "use the page")
    by_name = {setting.name: setting for setting in settings[model]}
    for name in changed:
        if name not in by_name:
            wanted = f"one such as {nearest_names(name[:40], by_name)}" if by_name else "none: it has no such settings"
            raise ConfigError(f"the setting {name[:40]!r}, which this model does not have", wanted, "use the page")
    seed = _whole("seed", values.get("seed", 0), 0, SEED_AT_MOST)
    count = _whole("count", values.get("count", 1), 1, limits.scans)
    if seed + count - 1 > SEED_AT_MOST:  # told here, not once the job has waited for its turn
        got = f"seed={seed} for {count} scans, each with the next seed"
        raise ConfigError(got, f"seeds up to {SEED_AT_MOST}", "lower one of the two")
    return SampleRequest(
        model,
        seed,
        count,
        {name: _number(by_name[name], value) for name, value in changed.items()},
        task,
        _region(values.get("region", [])),
        example=example,
        name=f"example {example}" if example else _harmless_name(values.get("name", "")),
    )


def upload_ending(name: str) -> str:
    """Return the ending of a file's name if a format reads such a file by itself, else ""."""
    fitting = [ending for ending in upload_endings() if name.lower().endswith(ending)]
    of_format = {ending for form in formats.candidates(Path(name)) for ending in form.suffixes}
    return max((ending for ending in fitting if ending in of_format), key=len, default="")


def upload_endings() -> list[str]:
    """Return the endings of files that can be uploaded: all but those that need a second file beside them."""
    forms = [formats.load(name) for name in names("formats")]
    return sorted({ending for form in forms if not form.companion for ending in form.suffixes})


def _about(sampling: type, name: str) -> str:
    """Return what a class's docstring says of a field, in one line."""
    text = "\n".join(inspect.cleandoc(each.__doc__ or "") for each in sampling.__mro__)
    found = re.search(rf"^    {name}: (.*?)(?=^    \w+: |^\S|\Z)", text, re.MULTILINE | re.DOTALL)
    return " ".join(found[1].split()).replace("``", "") if found else ""


def _key(name: str, value: Any, known: Collection[str]) -> str:
    if not isinstance(value, str) or value not in known:
        raise ConfigError(f"{name}={str(value)[:40]!r}", f"one of {', '.join(filter(None, known))}", "choose one")
    return value


def _whole(name: str, value: Any, at_least: int, at_most: int) -> int:
    check(Annotated[int, Bounds(at_least, at_most)], value, name)
    return value


def _number(setting: SamplingSetting, value: Any) -> int | float:
    if setting.whole:
        return _whole(setting.name, value, 0, int(setting.at_most))
    check(Annotated[float, Bounds(-setting.at_most, setting.at_most)], value, setting.name)
    return float(value)


def _region(value: Any) -> tuple[float, ...]:
    numbers = value if isinstance(value, list) else [value]
    if numbers and not (
        fits(tuple[Share, Share, Share, Share], tuple(numbers)) and numbers[0] < numbers[2] and numbers[1] < numbers[3]
    ):
        wanted = "left, top, right and bottom as shares of the image"
        raise ConfigError(f"region={str(value)[:40]}", wanted, "draw it anew")
    return tuple(float(number) for number in numbers)


def _harmless_name(name: Any) -> str:
    """Return the characters of a file's name that can do no harm anywhere, without any folder."""
    last = re.split(r"[/\\]", name if isinstance(name, str) else "")[-1]
    return re.sub(r"[^\w.()+-]", "_", last)[-60:]

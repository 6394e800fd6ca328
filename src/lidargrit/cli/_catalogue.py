"""What a user can choose from: a kind such as "datasets" → all its names, with the facts of each."""

import re
from typing import Any

from lidargrit.core import discovery

KINDS = tuple(kind for kind in discovery.FOLDERS if kind != "cli")
"""Each kind as a user types it."""
_FIRST = ("lidargrit_fine_small", "lidargrit_wide_pixels", "multiscale_small", "lidargrit_demo")
_GROUPS = ("to begin with: your own scans, 64x1024, to compress, a check for minutes", "others", "to compare with")


def entries(kind: str, in_full: bool = False) -> list[dict[str, Any]]:
    """Return the name and the summary of every entry of a kind, as plain values.

    Args:
        kind: one of ``KINDS``.
        in_full: whether the facts of each class are added: licence, splits and leaks of data sets; endings of formats;
            size and limits of sensors; capabilities, origin, licences and sampling settings of generators; direction,
            variants and weights of metrics. Presets come in the order in which a user needs them, with their group.

    Example:
        >>> entries("sensors")[0]["name"]
        'hdl32e'
    """
    about = _ABOUT.get(kind) if in_full else None
    found = []
    for group, name in _in_order(kind):
        shown = name.replace("_", "-") if kind == "protocols" else name
        summary = re.sub(r":\w+:`(\w+)`", r"\1", discovery.summary(kind, name))
        facts = {**({"group": group} if group else {}), **(about(name) if about else {})}
        found.append({"name": shown, "summary": summary, **facts})
    return found


def _in_order(kind: str) -> list[tuple[str, str]]:
    """Return the group and the name of every entry of a kind; only presets have groups, in the order of use."""
    names = discovery.names(kind)
    if kind != "presets":
        return [("", name) for name in names]
    apart = [name for name in names if discovery.table(kind, name) == discovery.TO_COMPARE_WITH]
    others = [name for name in names if name not in {*apart, *_FIRST}]
    return [(group, name) for group, each in zip(_GROUPS, (_FIRST, others, apart), strict=True) for name in each]


def lines(kind: str, entry: dict[str, Any]) -> list[str]:
    """Return the facts of one entry as lines for people; none for kinds that have only a summary."""
    if kind == "datasets":
        facts = [f"{name}: {entry[name]}" for name in ("layout", "sensor", "licence", "cite")]
        for number, scheme in enumerate(entry["schemes"]):
            parts = ", ".join(part if number == 0 else f"{scheme['name']}/{part}" for part in scheme["parts"])
            facts += [f"splits: {parts} ({scheme['name']}: {scheme['source']})", f"    leak: {scheme['leak']}"]
        return facts
    if kind in ("formats", "generators"):
        return entry["facts"]
    facts = {name: value for name, value in entry.items() if name not in ("name", "summary", "group")}
    return [f"{name.replace('_', ' ')}: {_in_words(value)}" for name, value in facts.items()]


def _in_words(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return ", ".join(value) if isinstance(value, list) else str(value) or "none"


def _of_dataset(name: str) -> dict[str, Any]:
    from lidargrit.data.datasets import load

    cls = load(name)
    schemes = [
        {
            "name": scheme,
            "source": of.source,
            "leak": of.leak,
            "parts": {part: list(all_) for part, all_ in of.parts.items()},
        }
        for scheme, of in cls.schemes.items()
    ]
    return {"layout": cls.tree, "sensor": cls.sensor, "licence": cls.licence, "cite": cls.citation, "schemes": schemes}


def _of_format(name: str) -> dict[str, Any]:
    from lidargrit.data.formats import load

    cls = load(name)
    return {"endings": list(cls.suffixes), "can_write": cls.can_write(), "extra": cls.extra, "facts": cls.about()}


def _of_generator(name: str) -> dict[str, Any]:
    from lidargrit.core import configuration
    from lidargrit.generation.generator import load_class

    cls = load_class(name)
    sampling, origin = configuration.to_json(cls.Sampling()), configuration.to_json(cls.facts)
    return {"capabilities": sorted(cls.capabilities), **origin, "sampling": sampling, "facts": cls.about()}


def _of_metric(name: str) -> dict[str, Any]:
    from lidargrit.evaluation.metrics import load_metric

    cls = load_metric(name)
    facts = {"higher_is_better": cls.higher_is_better, "variants": list(cls.variants)}
    return {"title": cls.title, **facts, "needs_weights": cls.needs_weights}


def _of_sensor(name: str) -> dict[str, Any]:
    from lidargrit.scans.sensors import load_sensor

    sensor = load_sensor(name)
    image = {"rows": sensor.height, "columns": sensor.width, "projection": sensor.projection}
    return {**image, "range_min_m": sensor.range_min_m, "range_max_m": sensor.range_max_m}


_ABOUT = {"datasets": _of_dataset, "formats": _of_format, "generators": _of_generator}
_ABOUT |= {"metrics": _of_metric, "sensors": _of_sensor}

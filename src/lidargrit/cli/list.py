"""List data sets, formats, sensors, generators, metrics, protocols, recipes and more."""

from __future__ import annotations

import argparse
import re
import textwrap

EXAMPLES = "  lidargrit list\n  lidargrit list generators\n"

_KINDS = {kind: kind for kind in ("datasets", "formats", "sensors", "tokenizers", "generators", "metrics")}
_KINDS |= {kind: f"evaluation.{kind}" for kind in ("protocols", "dialects")} | {"recipes": "recipes"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    parser.add_argument("kind", nargs="?", choices=_KINDS, help="one kind only, with all that is known of it")


def run(options: argparse.Namespace) -> None:
    """Print every name with its one line; of a kind asked for alone, all that is known."""
    from lidargrit import _discovery

    facts = {"datasets": _of_dataset, "formats": _of_format, "generators": _of_generator}.get(options.kind)
    wrapper = textwrap.TextWrapper(116, initial_indent=" " * 6, subsequent_indent=" " * 10, break_on_hyphens=False)
    for kind in (options.kind,) if options.kind else _KINDS:
        print(kind)
        for name in _discovery.names(_KINDS[kind]):
            summary = re.sub(r":\w+:`(\w+)`", r"\1", _discovery.summary(_KINDS[kind], name))
            print(f"  {name.replace('_', '-') if kind == 'protocols' else name:<36}{summary}")
            for fact in facts(name) if facts else ():
                print(wrapper.fill(fact))


def _of_dataset(name: str) -> list[str]:
    from lidargrit.datasets import load

    cls = load(name)
    facts = [f"layout: {cls.tree}", f"sensor: {cls.sensor}", f"licence: {cls.licence}", f"cite: {cls.citation}"]
    for number, (scheme, of) in enumerate(cls.schemes.items()):
        parts = ", ".join(part if number == 0 else f"{scheme}/{part}" for part in of.parts)
        facts += [f"splits: {parts} ({scheme}: {of.source})", f"    leak: {of.leak}"]
    return facts


def _of_format(name: str) -> list[str]:
    from lidargrit.formats import load

    return load(name).about()


def _of_generator(name: str) -> list[str]:
    from lidargrit.generators import load_class

    return load_class(name).about()

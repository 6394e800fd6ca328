"""List data sets, sensors, tokenizers, generators, metrics and recipes."""

from __future__ import annotations

import argparse

EXAMPLES = """\
  lidargrit list
  lidargrit list datasets
"""

_KINDS = ("datasets", "sensors", "tokenizers", "generators", "metrics", "recipes")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    parser.add_argument("kind", nargs="?", choices=_KINDS, help="one kind only")


def run(options: argparse.Namespace) -> None:
    """Print every name with its one line; data sets with their layout and licence."""
    from lidargrit import _discovery

    for kind in (options.kind,) if options.kind else _KINDS:
        print(kind)
        for name in _discovery.names(kind):
            print(f"  {name:<26}{_discovery.summary(kind, name)}")
            if options.kind == "datasets":
                from lidargrit.datasets import load

                print(f"  {'':<26}layout: {load(name).tree}\n  {'':<26}licence: {load(name).licence}")

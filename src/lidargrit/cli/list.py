"""List data sets, formats, sensors, generators, metrics, protocols, presets and more."""

import argparse
import textwrap

from lidargrit.cli._catalogue import KINDS
from lidargrit.cli._results import add_json, print_result, refuse_taken

EXAMPLES = """\
  lidargrit list
  lidargrit list generators
  lidargrit list datasets --json                    licences, splits and leaks, for programs
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("kind", nargs="?", choices=KINDS, help="list one kind only, with all that is known of it")
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    from lidargrit.cli._catalogue import entries, lines

    refuse_taken(options)
    kinds = [options.kind] if options.kind else KINDS
    found = {kind: entries(kind, bool(options.kind)) for kind in kinds}
    wrapper = textwrap.TextWrapper(116, initial_indent=" " * 6, subsequent_indent=" " * 10, break_on_hyphens=False)
    printed = []
    for kind, of_kind in found.items():
        printed.append(kind)
        group = ""
        for entry in of_kind:
            if entry.get("group", "") != group:
                group = entry["group"]
                printed.append(f"  {group}:")
            printed.append(f"  {entry['name']:<36}{entry['summary']}")
            printed += [wrapper.fill(line) for line in (lines(kind, entry) if options.kind else [])]
    print_result(options, "\n".join(printed), found)

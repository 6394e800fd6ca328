"""Train, sample and score several systems on the same data by one protocol, and say which is better."""

import argparse
from pathlib import Path

from lidargrit.cli._comparison import DEFAULTS, wanted
from lidargrit.cli._options import add_settings
from lidargrit.cli._results import add_json, print_result, refuse_taken

EXAMPLES = """\
  lidargrit compare table marginal memorised lidargrit_small dusty_small r2dm_small:steps=32
  lidargrit compare table lidargrit_small r2dm_small --flops 2e14 -n 1000      equal compute for all
  lidargrit compare table runs/mine their_samples --against /data/held_out  is the second better than the first?
  lidargrit compare table --add runs/another                          as the others of the table were compared
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    parser.set_defaults(goes_on=True)
    parser.add_argument("out", type=Path, help="folder for runs, samples and scores; the same command continues there")
    what = "name of a preset, or folder of a finished run or of samples; SYSTEM:NAME=VALUE,... sets how it is sampled"
    parser.add_argument("systems", nargs="*", metavar="SYSTEM", help=what)
    added = "systems to compare as those of the table in OUT were, with the settings that it was made with"
    parser.add_argument("--add", nargs="+", default=[], metavar="SYSTEM", help=added)
    at_once = "number of systems to make at the same time, each in a process of its own"
    parser.add_argument("--processes", type=int, default=1, help=at_once)
    # No defaults here: beside --add any of these is refused.
    of = {name: f"(default: {value})" for name, value in DEFAULTS.items()}
    parser.add_argument("--against", metavar="SOURCE", help=f"real scans to compare with {of['against']}")
    parser.add_argument("-n", "--count", type=int, help=f"number of samples of each system {of['count']}")
    protocol, metrics = "name of a protocol, see: lidargrit list protocols", "metrics instead of the protocol's"
    parser.add_argument("--protocol", help=f"{protocol} {of['protocol']}")
    parser.add_argument("--metrics", nargs="+", help=f"{metrics}, see: lidargrit list metrics")
    settings = "settings to change in every preset, such as data.train=/data/scans"
    add_settings(parser, settings)
    budget = "training budget of each system in floating-point operations (default: each preset's own)"
    parser.add_argument("--flops", type=float, help=budget)
    parser.add_argument("--format", choices=["text", "markdown", "latex"], default="text", help="format of the table")
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Run the benchmark, write the table and its page, and print it."""
    from lidargrit.core.files import write_text
    from lidargrit.evaluation.benchmark import as_json, as_table
    from lidargrit.evaluation.benchmark import run as run_benchmark
    from lidargrit.evaluation.table_folder import TABLE, write_table
    from lidargrit.viewer.table_page import table_page

    refuse_taken(options, options.out / TABLE)
    systems, benchmark = wanted(options)
    scores = run_benchmark(systems, options.out, benchmark, options.processes)
    write_table(options.out, systems, benchmark, scores)
    write_text(options.out / "table.html", table_page(as_json(scores), benchmark.flops))
    done = f"done: {options.out / 'table.html'} sorts the table in a browser"
    print_result(options, as_table(scores, options.format), as_json(scores), done)

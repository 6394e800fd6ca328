"""Train, sample and score several systems on the same data by one protocol, and set them side by side."""

from __future__ import annotations

import argparse
from pathlib import Path

from lidargrit.cli._options import add_settings
from lidargrit.cli._results import add_json, print_result, refuse_taken

EXAMPLES = """\
  lidargrit compare table marginal memorised small dusty_small r2dm_small:steps=32
  lidargrit compare table small r2dm_small --flops 2e14 -n 1000      equal compute for all
  lidargrit compare table runs/mine runs/theirs --against /data/held_out
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    parser.add_argument("out", type=Path, help="folder for runs, samples and scores; the same command continues there")
    what = "name of a recipe or folder of a finished run; SYSTEM:NAME=VALUE,... also sets how it is sampled"
    parser.add_argument("systems", nargs="+", metavar="SYSTEM", help=what)
    parser.add_argument("--against", default="simulated:256:test", metavar="SOURCE", help="real scans to compare with")
    parser.add_argument("-n", "--count", type=int, default=256, help="number of samples of each system")
    parser.add_argument("--protocol", default="exact", help="name of a protocol, see: lidargrit list protocols")
    parser.add_argument(
        "--metrics", nargs="+", default=[], help="metrics instead of the protocol's, see: lidargrit list metrics"
    )
    settings = "settings to change in every recipe, such as data.train=/data/scans"
    add_settings(parser, settings)
    budget = "training budget of each system in floating-point operations (default: each recipe's own)"
    parser.add_argument("--flops", type=float, default=0.0, help=budget)
    parser.add_argument("--batch-size", type=int, help="no effect any more: each generator has a batch size of its own")
    parser.add_argument("--format", choices=["text", "markdown", "latex"], default="text", help="format of the table")
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Run the benchmark and print the table."""
    from lidargrit.evaluation.benchmark import Benchmark, as_json, as_table
    from lidargrit.evaluation.benchmark import run as run_benchmark
    from lidargrit.evaluation.comparison import EvalConfig
    from lidargrit.reporting import TerminalReporter

    refuse_taken(options)
    benchmark = Benchmark(
        reference=options.against,
        num_samples=options.count,
        settings=EvalConfig(protocol=options.protocol, metrics=tuple(options.metrics)),
        recipe_settings=tuple(options.set),
        flops=options.flops,
    )
    scores = run_benchmark(options.systems, options.out, benchmark, TerminalReporter())
    print_result(options, as_table(scores, options.format), as_json(scores))

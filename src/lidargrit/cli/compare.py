"""Train, sample and score several systems on the same data by one protocol, and set them side by side."""

from __future__ import annotations

import argparse
from pathlib import Path

from lidargrit.cli._results import add_json, refuse_taken, tell

EXAMPLES = """\
  lidargrit compare table marginal memorised small dusty_small r2dm_small:steps=32
  lidargrit compare table small r2dm_small --flops 2e14 -n 1000      equal compute for all
  lidargrit compare table runs/mine runs/theirs --against /data/held_out
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    parser.add_argument("out", type=Path, help="folder of runs, samples and scores; the same command goes on there")
    drawn = "recipes or finished runs; RECIPE:NAME=VALUE,... tells how it is drawn from"
    parser.add_argument("systems", nargs="+", metavar="SYSTEM", help=drawn)
    parser.add_argument("--against", default="simulated:256:test", help="real scans (default: simulated:256:test)")
    parser.add_argument("-n", "--count", type=int, default=256, help="samples of each (default: 256)")
    parser.add_argument("--protocol", default="exact", help="see: lidargrit list protocols (default: exact)")
    parser.add_argument("--metrics", nargs="+", default=[], help="in place of the protocol's: lidargrit list metrics")
    settings = "settings of every recipe, such as data.train=..."
    parser.add_argument("--set", nargs="+", action="extend", default=[], metavar="NAME=VALUE", help=settings)
    budget = "operations that the training of each takes (default: each recipe's own budget)"
    parser.add_argument("--flops", type=float, default=0.0, help=budget)
    parser.add_argument("--batch-size", type=int, default=8, help="scans drawn at once (default: 8)")
    parser.add_argument("--format", choices=["text", "markdown", "latex"], default="text", help="of the table")
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
        batch_size=options.batch_size,
    )
    scores = run_benchmark(options.systems, options.out, benchmark, TerminalReporter())
    tell(options, as_table(scores, options.format), as_json(scores))

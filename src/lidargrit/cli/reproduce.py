"""Reproduce a table of the paper: prepare, train, sample, score, and print it beside the published rows."""

import argparse
from pathlib import Path

from lidargrit.cli._options import add_settings
from lidargrit.cli._results import add_json, print_result, refuse_taken

EXAMPLES = """\
  lidargrit reproduce 3 simulated ablation --small                 a small counterpart, a quarter of an hour
  lidargrit reproduce 3 /data/kitti_odometry ablation --dry-run    what it would do and cost
  lidargrit reproduce 1 /data/KITTI-360 table1                     weeks of a GPU; the same command goes on
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    parser.set_defaults(goes_on=True)
    parser.add_argument("table", type=int, help="number of the table in the paper: 1, 2 or 3")
    parser.add_argument(
        "root", help="root folder of KITTI-360 (table 1) or KITTI odometry (tables 2, 3), or the word simulated"
    )
    parser.add_argument("out", type=Path, help="folder for runs, samples and scores; the same command continues there")
    small = "use the small presets at equal compute, and no metric that needs published weights"
    parser.add_argument("--small", action="store_true", help=small)
    count = "number of samples of each system (default: the paper's 5,000; 64 with --small)"
    parser.add_argument("-n", "--count", type=int, default=0, help=count)
    budget = "training budget of each system in floating-point operations (default: each preset's; 5e13 with --small)"
    parser.add_argument("--flops", type=float, help=budget)
    settings = "settings to change in every preset, such as data.workers=16"
    add_settings(parser, settings)
    parser.add_argument("--format", choices=["text", "markdown", "latex"], default="text", help="format of the table")
    parser.add_argument("--dry-run", action="store_true", help="print what would be done and what it costs, and stop")
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Reproduce the table, or print the plan."""
    from lidargrit.evaluation.benchmark import as_json
    from lidargrit.evaluation.reproduction import Reproduction, plan, plan_as_text, reproduce, table_of

    refuse_taken(options)
    wanted = Reproduction(
        options.table,
        options.root,
        options.small,
        options.count,
        options.flops,
        tuple(options.set),
    )
    if options.dry_run:
        facts = plan(wanted, options.out)
        print_result(options, plan_as_text(wanted, facts), facts)
        return
    scores = reproduce(wanted, options.out)
    print_result(options, table_of(wanted, scores, options.format), as_json(scores))

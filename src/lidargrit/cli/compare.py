"""Train, sample and score systems alike, and say which is better; tables of the paper; models that complete scans."""

import argparse
from pathlib import Path

from lidargrit.cli._comparison import COMPLETION, DEFAULTS, compared
from lidargrit.cli._options import add_device, add_scans
from lidargrit.cli._results import add_json, print_result, refuse_taken
from lidargrit.core.untrusted import WholeNumber, process_count, seed_number, whole_number

EXAMPLES = """\
  lidargrit compare table lidargrit_small r2dm_small --flops 2e14 -n 1000      equal compute for all
  lidargrit compare table runs/mine their_samples --reference /data/held_out   is the second better than the first?
  lidargrit compare table --add runs/another theirs.json              as the others of the table were compared
  lidargrit compare paper --paper-table 3 --data /data/kitti_odometry --dry-run    --data simulated --small: minutes
  lidargrit compare filled pretrained linear --protocol completion --observed rows:8 --reference /data/held_out
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(goes_on=True)
    add = parser.add_argument
    add("out", type=Path, help="folder for runs, samples and scores; the same command continues there")
    what = "preset, run, samples or scores (.json); SYSTEM:NAME=VALUE,... sets how it is sampled"
    add("systems", nargs="*", metavar="SYSTEM", help=what)
    add("--add", nargs="+", default=[], metavar="SYSTEM", help="further systems for the table in OUT")
    # No defaults here: beside --add any of these is refused.
    of = {name: f"(default: {value})" for name, value in DEFAULTS.items()}
    add("--reference", metavar="SCANS", help=f"real scans {of['reference']}")
    add("-n", "--count", type=whole_number, metavar="N", help=f"samples of each system, and scans {of['count']}")
    protocol = f"one of: lidargrit list protocols {of['protocol']}, or completion"
    add("--protocol", metavar="NAME", help=protocol)
    add("--metrics", nargs="+", metavar="NAME", help="others than the protocol's: lidargrit list metrics")
    add("--flops", type=float, metavar="N", help="training operations of each system (default: its own)")
    add("--workers", type=process_count, default=1, metavar="N", help="number of systems made at the same time")
    add("--paper-table", type=WholeNumber(1, 3), metavar="N", help="table 1, 2 or 3 of the paper")
    add("--data", default="", metavar="ROOT", help="data set of the paper table, or the word simulated")
    add("--small", action="store_true", help="small presets for the paper table")
    add("--dry-run", action="store_true", help="print what the paper table takes, and stop")
    add("--observed", nargs="+", default=[], metavar="PATTERN", help="what completion is given, as of complete")
    add("--samples", type=WholeNumber(1), default=2, metavar="N", help="number of completions of each scan")
    add("--seed", type=seed_number, default=0, metavar="N", help="seed of completions and of random pixels")
    add_scans(parser, "settings of all presets, or of reading scans")
    add_device(parser)
    forms = ["text", "markdown", "latex"]
    add("--table", choices=forms, default="text", metavar="FORM", help="text, markdown or latex")
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    refuse_taken(options, options.protocol == COMPLETION)
    print_result(options, *compared(options))

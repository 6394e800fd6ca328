"""Train, sample and score systems alike, and say which is better; tables of the paper; models that complete scans."""

import argparse
from pathlib import Path

from lidargrit.cli._comparison import COMPLETED, DEFAULTS, compared
from lidargrit.cli._options import add_device, add_scans
from lidargrit.cli._results import add_json, add_table, print_result, refuse_taken
from lidargrit.core.untrusted import seed_number

EXAMPLES = """\
  lidargrit compare table lidargrit_small r2dm_small --flops 2e14 -n 1000      equal compute for all
  lidargrit compare table runs/mine their_samples --reference /data/held_out   is the second better than the first?
  lidargrit compare table --add runs/another                          as the others of the table were compared
  lidargrit compare paper --paper-table 3 --data /data/kitti_odometry --dry-run    --data simulated --small: minutes
  lidargrit compare filled pretrained linear --protocol completion --observed rows:8 --reference /data/held_out
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    parser.set_defaults(goes_on=True)
    add = parser.add_argument
    add("out", type=Path, help="folder for runs, samples and scores; the same command continues there")
    what = "preset, or folder of a finished run or of samples; SYSTEM:NAME=VALUE,... sets how it is sampled"
    add("systems", nargs="*", metavar="SYSTEM", help=what)
    add("--add", nargs="+", default=[], metavar="SYSTEM", help="systems to compare as those of the table in OUT were")
    # No defaults here: beside --add any of these is refused.
    of = {name: f"(default: {value})" for name, value in DEFAULTS.items()}
    add("--reference", metavar="SCANS", help=f"real scans to compare with {of['reference']}")
    add("-n", "--count", type=int, help=f"number of samples of each system {of['count']}, and of scans")
    add("--protocol", help=f"a name from: lidargrit list protocols {of['protocol']}; or completion, of hidden parts")
    add("--metrics", nargs="+", help="metrics instead of the protocol's, see: lidargrit list metrics")
    budget = "training budget of each system in floating-point operations (default: each preset's own)"
    add("--flops", type=float, help=budget)
    add("--workers", type=int, default=1, help="number of systems to make at the same time")
    add("--paper-table", type=int, metavar="N", help="table 1, 2 or 3 of the paper: its systems and its protocol")
    add("--data", default="", metavar="ROOT", help="folder of the paper table's data set, or the word simulated")
    add("--small", action="store_true", help="small presets for the paper table, and no metric with published weights")
    add("--dry-run", action="store_true", help="print what the paper table would take, and stop")
    add("--observed", nargs="+", default=[], metavar="PATTERN", help="what stays in completion, as of complete")
    add("--samples", type=int, default=2, metavar="S", help="number of completions of each scan")
    add("--seed", type=seed_number, default=0, help="seed of the completions and of random pixels")
    add_scans(parser, "settings of every preset, such as data.train=/data/scans; of completion those of reading scans")
    add_device(parser)
    add_table(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    """Compare, write the table, and print it."""
    refuse_taken(options, options.out / "table.json", options.out / COMPLETED)
    print_result(options, *compared(options))

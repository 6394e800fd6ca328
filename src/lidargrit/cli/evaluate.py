"""Score any scans against any others, or what a run keeps of scans; or set scores side by side."""

from __future__ import annotations

import argparse
from pathlib import Path

from lidargrit.cli._results import add_json, refuse_taken, tell
from lidargrit.untrusted import seed_number

EXAMPLES = """\
  lidargrit evaluate samples /data/held_out --report report.html
  lidargrit evaluate samples kitti_360:/data/kitti_360:test --protocol lidargrit-kitti-360 --json scores.json
  lidargrit evaluate r2dm_samples kitti_360:/data/kitti_360 --protocol r2dm --weights pointnet=cls_model_39.pth
  lidargrit evaluate runs/mine /data/held_out          errors of reconstruction, for a run instead of samples
  lidargrit evaluate --tables ours.json theirs.json --format markdown
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    add = parser.add_argument
    add("samples", nargs="?", default="", help="samples of ours or of others (.pth), a source of scans, or a run")
    add("reference", nargs="?", default="", help="likewise; projected with the sensor of the samples")
    add("--protocol", default="exact", help="exact (default), lidargrit-kitti-360, lidargrit-kitti-odometry, r2dm, ...")
    add("--metrics", nargs="+", default=[], help="in place of the protocol's; see: lidargrit list metrics")
    add("--variant", default="", help="one definition of every metric, in place of the protocol's")
    add("--projection-variant", choices=["exact", "reference"], help="of scans (default: the protocol's)")
    add("--samples-format", default="", help="r2dm, lidargen or lidargrit, where .pth files do not tell")
    add("--weights", nargs="+", default=[], metavar="NAME=FILE", help="of pointnet and rangenet53")
    add("-n", "--max-scans", type=int, default=0, help="at most so many of each; 0 for the protocol's")
    add("--intervals", type=int, default=20, metavar="B", help="half-samples for intervals; 0 for none (default: 20)")
    add("--groups", type=int, default=16, metavar="G", help="of neighbouring scans that stay together (default: 16)")
    add("--seed", type=seed_number, default=0, help="of whatever is drawn")
    add("--device", default="cpu", help="where trained networks compute: cpu or cuda")
    add("--bad-points", choices=["refuse", "drop"], default="refuse", help="NaN, infinite or at 0")
    add("--bad-scans", choices=["refuse", "skip"], default="refuse", help="that cannot be used")
    add("--report", type=Path, metavar="FILE.html", help="also write one page with scores and pictures")
    add_json(parser, "the files of --json and --report")
    add("--tables", nargs="+", type=Path, metavar="JSON", help="set files of --json side by side, and do nothing else")
    add("--format", choices=["text", "markdown", "latex"], default="text", help="of the table (default: text)")


def run(options: argparse.Namespace) -> None:
    """Score and print a table."""
    from lidargrit.evaluation.command import evaluate
    from lidargrit.evaluation.tables import side_by_side
    from lidargrit.files import read_json
    from lidargrit.reporting import TerminalReporter
    from lidargrit.viewer.report import write_report

    refuse_taken(options)
    if options.tables:
        table = side_by_side(options.tables, options.format)
        tell(options, table, {path.stem: read_json(path) for path in options.tables})
        return
    tell(options, *evaluate(options, TerminalReporter(), write_report))

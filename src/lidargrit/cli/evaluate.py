"""Score samples against real scans, measure a run's reconstruction errors, or print saved scores side by side."""

import argparse
from pathlib import Path

from lidargrit.cli._options import add_scans, scan_settings
from lidargrit.cli._results import add_json, files_told, print_result, refuse_taken
from lidargrit.core.untrusted import seed_number

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
    samples = "samples of lidargrit or of another program (.pth), a source of scans, or a run"
    add("samples", nargs="?", default="", help=samples)
    add("reference", nargs="?", default="", help="scans to compare with; projected with the sensor of the samples")
    add("--protocol", default="exact", help="metrics and their definitions, see: lidargrit list protocols")
    add("--metrics", nargs="+", default=[], help="metrics instead of the protocol's, see: lidargrit list metrics")
    add("--variant", default="", help="published definition of every metric; see: lidargrit list metrics")
    add("--samples-format", default="", help="program that wrote .pth files: r2dm, lidargen or lidargrit")
    add("--weights", nargs="+", default=[], metavar="NAME=FILE", help="weights of pointnet and rangenet53")
    add("-n", "--max-scans", type=int, default=0, help="largest number of scans of each; 0 for the protocol's")
    add("--intervals", type=int, default=20, metavar="B", help="number of half-samples for 95 %% intervals; 0 for none")
    add("--pixel-statistics", action="store_true", help="also score pixel statistics, which any model has to beat")
    add("--groups", type=int, default=16, metavar="G", help="groups of scans in half-samples; odd: rounded down")
    add("--seed", type=seed_number, default=0, help="seed of all random choices")
    add("--device", default="cpu", help="device of networks: cpu, or cuda, which changes the last digits of scores")
    add_scans(parser)
    add("--report", type=Path, metavar="FILE.html", help="also write a page with scores and pictures")
    add_json(parser, "the files of --json and --report")
    add("--tables", nargs="+", type=Path, metavar="JSON", help="only print saved scores side by side")
    add("--format", choices=["text", "markdown", "latex"], default="text", help="format of the table")


def run(options: argparse.Namespace) -> None:
    """Score and print a table."""
    from lidargrit.evaluation.command import check_modes, evaluate, read_config
    from lidargrit.evaluation.tables import read_tables
    from lidargrit.viewer.report import write_report

    refuse_taken(options)
    check_modes(vars(options), options.words.get_default)
    if options.tables:
        return print_result(options, *read_tables(options.tables, options.format))
    names = "protocol metrics variant max_scans seed samples_format device weights groups intervals pixel_statistics"
    config = read_config(scan_settings(options), **{name: vars(options)[name] for name in names.split()})
    sets, report = (options.samples, options.reference), (options.report, write_report, options.overwrite)
    text, values, also = evaluate(*sets, config, *report)
    print_result(options, text, values, files_told(scores=options.json, report=options.report), also)

"""Label every point of scans with its class, by SemanticKITTI's numbers."""

import argparse
from pathlib import Path

from lidargrit.cli._options import add_count, add_device, add_scans, scan_settings
from lidargrit.cli._results import add_json, look_at, print_result, refuse_taken
from lidargrit.core.errors import counted_scans

EXAMPLES = """\
  lidargrit segment /data/scans labelled                 a KITTI tree with labels/NNNNNN.label
  lidargrit view labelled -o labelled.html               look at it; colour by label
  lidargrit segment /data/scans labelled --model runs/mine
  lidargrit segment simulated:16:val labelled --compare semantic_kitti       how well it finds their own labels
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(goes_on=True)
    add = parser.add_argument
    add("scans", help="scans: a file, a folder, NAME:ROOT:SPLIT, samples, prepared scans, or range images as .npy")
    add("out", type=Path, help="folder for the tree: empty, or begun by the same command")
    add("--model", default="pretrained", help="segmenter's run (default: pretrained)")
    add_count(parser)
    compare = "also compare with the scans' own labels of this numbering: semantic_kitti, pandaset or nuscenes"
    add("--compare", default="", metavar="NUMBERING", help=compare)
    add_scans(parser)
    add_device(parser)
    add_json(parser)


def run(options: argparse.Namespace) -> None:
    from lidargrit.data.sources.scan_sensor import refuse_other_sensor
    from lidargrit.inference.segment.command import segment_scans

    refuse_taken(options)
    named = (options.scans, options.out, options.model)
    settings = scan_settings(options, max_scans=options.count)
    refuse_other_sensor(settings, options.model, "segment")
    count, scores = segment_scans(*named, settings.data, options.device, options.compare)
    found = scores.as_json() if scores else {}
    done = f"done: {counted_scans(count, 'labelled')} in {options.out}; {look_at(options.out)}"
    result = {"source": options.scans, "model": options.model, "scans": count, **found}
    print_result(options, scores.as_table() if scores else done, result, done if scores else "")

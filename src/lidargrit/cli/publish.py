"""Write a folder for the Hugging Face hub: a run's weights and configuration, with a model card; uploads nothing."""

import argparse
from pathlib import Path

EXAMPLES = """\
  lidargrit publish runs/mine to_share
  lidargrit publish runs/mine to_share --scores scores.json        scores written by: lidargrit evaluate --json
  lidargrit publish runs/mine to_share --notes failures.md --bits 32    four times the size, and nothing rounded
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(goes_on=True)
    add = parser.add_argument
    add("run_folder", type=Path, metavar="RUN", help="folder of a finished run")
    add("out", type=Path, help="folder for the weights, their configuration and the model card")
    scores = "scores of the run's samples for the card, written by: lidargrit evaluate --json"
    add("--scores", type=Path, metavar="JSON", help=scores)
    add("--notes", type=Path, metavar="MD", help="Markdown file for the end of the card, such as known failures")
    bits = "bits of a stored weight; networks compute in 32 bits whatever it is (default: 8; 32 beside --scores)"
    add("--bits", type=int, choices=(8, 16, 32), help=bits)


def run(options: argparse.Namespace) -> None:
    from lidargrit.core.files import read_text
    from lidargrit.publishing import publish

    notes = read_text(options.notes) if options.notes else ""
    publish(options.run_folder, options.out, options.scores, notes, options.bits)
    print(f"done: read {options.out / 'README.md'} before you share it; to upload: hf upload USER/NAME {options.out}")

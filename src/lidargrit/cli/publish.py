"""Write what of a run others need, with a model card, as the Hugging Face hub wants it; uploads nothing."""

from __future__ import annotations

import argparse
from pathlib import Path

EXAMPLES = """\
  lidargrit publish runs/mine to_share
  lidargrit publish runs/mine to_share --scores scores.json        which lidargrit evaluate --json wrote
  lidargrit publish runs/mine to_share --notes failures.md --half  16 bits a weight: half the size
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    parser.add_argument("run_folder", type=Path, metavar="RUN", help="folder of a finished run")
    parser.add_argument("out", type=Path, help="folder for the weights, their configuration and the card")
    parser.add_argument("--scores", type=Path, metavar="JSON", help="of the run's samples, for the card")
    parser.add_argument("--notes", type=Path, metavar="MD", help="Markdown for the end of the card, such as failures")
    parser.add_argument("--half", action="store_true", help="round weights to 16 bits")


def run(options: argparse.Namespace) -> None:
    """Write the folder."""
    from lidargrit.files import read_text
    from lidargrit.publishing import publish

    notes = read_text(options.notes) if options.notes else ""
    publish(options.run_folder, options.out, options.scores, notes, options.half)
    print(f"done: read {options.out / 'README.md'} before you share it; to upload: hf upload USER/NAME {options.out}")

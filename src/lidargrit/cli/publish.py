"""Write what of a run others need, with a model card, as the Hugging Face hub wants it; uploads nothing."""

from __future__ import annotations

import argparse
from pathlib import Path

EXAMPLES = """\
  lidargrit publish runs/mine to_share
  lidargrit publish runs/mine to_share --scores scores.json        which lidargrit evaluate --json wrote
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    parser.add_argument("run_folder", type=Path, metavar="RUN", help="folder of a finished run")
    parser.add_argument("out", type=Path, help="folder for the weights, their configuration and the card")
    parser.add_argument("--scores", type=Path, metavar="JSON", help="of the run's samples, for the card")


def run(options: argparse.Namespace) -> None:
    """Write the folder."""
    from lidargrit.publishing import publish

    publish(options.run_folder, options.out, options.scores)
    print(f"done: read {options.out / 'README.md'} before you share it; to upload: hf upload USER/NAME {options.out}")

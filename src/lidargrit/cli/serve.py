"""Generate, complete, compare and save scans on a page in the browser, on this machine."""

from __future__ import annotations

import argparse
from pathlib import Path

EXAMPLES = """\
  lidargrit serve                          all runs in runs/ and the model in the package
  lidargrit serve runs/demo runs/mine --port 8080
  ssh -L 8000:localhost:8000 MACHINE       and then here: a far machine's page in a browser here
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Name the options."""
    parser.add_argument("runs", nargs="*", type=Path, metavar="RUN", help="finished runs (default: runs/*, pretrained)")
    others = "let others in: the address to listen at, such as 0.0.0.0 (default: this machine only)"
    parser.add_argument("--host", default="127.0.0.1", help=others)
    parser.add_argument("--port", type=int, default=8000, help="0 for any that is free (default: 8000)")
    parser.add_argument("--seconds", type=float, default=120.0, help="that one drawing may take (default: 120)")
    parser.add_argument("--device", default="", help="cpu, cuda or cuda:1 (default: cuda if there is one)")


def run(options: argparse.Namespace) -> None:
    """Serve until interrupted."""
    from lidargrit.generators import locate
    from lidargrit.serving import Limits, finished_runs, serve

    runs = [locate(run) for run in options.runs] or finished_runs(Path("runs"))
    limits = Limits(seconds=options.seconds)
    serve(runs, lambda text: print(text, flush=True), options.host, options.port, options.device, limits)

"""Generate, complete, compare and save scans on a page in the browser, on this machine."""

import argparse
from functools import partial
from pathlib import Path

from lidargrit.cli._options import add_device
from lidargrit.core.untrusted import Number, WholeNumber

EXAMPLES = """\
  lidargrit serve                          all runs in runs/ and the models in the package
  lidargrit serve --open                   the same, and opens the page in the browser
  lidargrit serve runs/demo runs/mine --port 8080
  ssh -L 8000:localhost:8000 MACHINE       and then here: a far machine's page in a browser here
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(waits=True)
    add = parser.add_argument
    runs = "folders of finished runs (default: all in runs/, and the models in the package)"
    add("runs", nargs="*", type=Path, metavar="RUN", help=runs)
    host = "address to listen at; 0.0.0.0 lets other machines in (default: 127.0.0.1, this machine only)"
    add("--host", default="127.0.0.1", help=host)
    add("--port", type=WholeNumber(at_most=65_535), default=8000, help="port to listen at; 0 for any free one")
    add("--open", action="store_true", help="open the page in this machine's browser, too")
    add("--seconds", type=Number(0.001, 86_400.0), default=120.0, help="time limit of one request, in seconds")
    add_device(parser)


def run(options: argparse.Namespace) -> None:
    from lidargrit.data.run_folder import locate, named_folder, read_config

    for run in options.runs:  # first, for the server takes long to load
        read_config(locate(run))
    from lidargrit.viewer.serve import Limits, finished_runs, serve

    say = partial(print, flush=True)
    runs = [named_folder(run) for run in options.runs] or finished_runs(Path("runs"), say)
    limits = Limits(seconds=options.seconds)
    serve(runs, say, options.host, options.port, options.device, limits, options.open)

"""Train in legs of some minutes: ``python benchmarks/relay leg RUN OUT``, ``unpack OUT RUN``."""

import argparse
import os
import sys
from pathlib import Path

from leg import Leg, run_leg
from packing import pack, unpack

from lidargrit.core import reporting
from lidargrit.core.errors import LidarGritError

_PRESET = "lidargrit_fine_wide"


def _main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    verbs = parser.add_subparsers(dest="verb", required=True)
    trained = verbs.add_parser("leg", help="train further for some seconds, then pack")
    trained.add_argument("run", type=Path, help="folder of the relay")
    trained.add_argument("out", type=Path, help="folder for what must travel back")
    trained.add_argument("--preset", default=_PRESET)
    trained.add_argument("--seconds", type=float, default=500.0)
    trained.add_argument("--processes", type=int, default=max(1, (os.cpu_count() or 2) - 1))
    packed = verbs.add_parser("pack", help="pack in fewer bits, for a machine that takes less or for a commit")
    packed.add_argument("run", type=Path)
    packed.add_argument("out", type=Path)
    packed.add_argument("--room", type=float, default=60.0, help="MiB that it may take")
    taken = verbs.add_parser("unpack", help="put what came back into the folder of the relay")
    taken.add_argument("packed", type=Path)
    taken.add_argument("run", type=Path)
    given = parser.parse_args()
    try:
        if given.verb == "unpack":
            unpack(given.packed, given.run)
        elif given.verb == "pack":
            print(pack(given.run, given.out, int(given.room * 2**20)))
        else:
            leg = Leg(given.preset, given.run, given.seconds, given.processes)
            try:
                run_leg(leg, saved=lambda: print(pack(given.run, given.out), flush=True))
            finally:  # whatever went wrong, the last checkpoint travels; with it, what the leg reached
                print(pack(given.run, given.out), flush=True)
    except LidarGritError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    with reporting.to(reporting.TerminalReporter()):
        sys.exit(_main())

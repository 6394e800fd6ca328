"""The worker process of the server; see worker.py."""

import json
import sys
from pathlib import Path

from lidargrit.viewer.serve.worker import run_worker

options = json.loads(sys.argv[1])
try:
    run_worker([Path(run) for run in options["runs"]], options["device"])
except (KeyboardInterrupt, BrokenPipeError):
    sys.exit(130)

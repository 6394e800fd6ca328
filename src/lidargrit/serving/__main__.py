"""The process that draws; see drawing.py."""

import json
import sys
from pathlib import Path

from lidargrit.serving.worker import run_worker

asked = json.loads(sys.argv[1])
try:
    run_worker([Path(run) for run in asked["runs"]], asked["device"])
except (KeyboardInterrupt, BrokenPipeError):
    sys.exit(130)

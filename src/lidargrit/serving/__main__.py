"""The process that draws; see drawing.py."""

import json
import sys
from pathlib import Path

from lidargrit.serving.drawing import work

asked = json.loads(sys.argv[1])
try:
    work([Path(run) for run in asked["runs"]], asked["device"])
except (KeyboardInterrupt, BrokenPipeError):
    sys.exit(130)

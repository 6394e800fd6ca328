"""Entry point of one of the processes that make shards; see workers.py."""

import sys
from pathlib import Path

from lidargrit.loading.workers import make_some_shards

try:
    sys.exit(make_some_shards(Path(sys.argv[1]), int(sys.argv[2]), [int(shard) for shard in sys.argv[3:]]))
except (KeyboardInterrupt, BrokenPipeError):
    sys.exit(130)

"""Entry point of one of the processes that make shards; see workers.py."""

import os
import signal
import sys
from pathlib import Path

from lidargrit.data.prepared.workers import make_some_shards

signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that a half-written file is removed
try:
    code = make_some_shards(Path(sys.argv[1]), int(sys.argv[2]), [int(shard) for shard in sys.argv[3:]])
except (KeyboardInterrupt, BrokenPipeError):
    code = 130
    # Nobody may read any more, and what is left to print would be told as an error when Python ends.
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
signal.signal(signal.SIGTERM, signal.SIG_IGN)  # it is about to end, which nothing should interrupt
sys.exit(code)

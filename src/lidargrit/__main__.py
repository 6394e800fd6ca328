"""Run ``python -m lidargrit`` like the command ``lidargrit``."""

import sys

from lidargrit.cli import main

sys.exit(main())

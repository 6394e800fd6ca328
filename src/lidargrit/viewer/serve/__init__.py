"""Trained runs in a browser: run folders → a page on this machine that generates, completes, compares and saves."""

from lidargrit.viewer.serve.requests import Limits
from lidargrit.viewer.serve.server import finished_runs, serve

__all__ = ["Limits", "finished_runs", "serve"]

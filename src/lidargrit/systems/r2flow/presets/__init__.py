"""Experiments with ``r2flow``, one a file."""

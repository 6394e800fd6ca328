"""Experiments with ``r2dm``, one a file."""

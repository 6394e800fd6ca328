"""Experiments with ``memorised``, one a file."""

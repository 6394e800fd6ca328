"""Experiments with ``completion``, one a file."""

"""Experiments with ``completion_only``, one a file."""

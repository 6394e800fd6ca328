"""Experiments with ``lidargen``, one a file."""

"""Experiments with ``lidargan``, one a file."""

"""Experiments with ``ultralidar``, one a file."""

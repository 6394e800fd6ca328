"""Experiments with ``dusty``, one a file."""

"""Experiments with ``raydrop``, one a file."""

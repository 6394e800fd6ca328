"""Experiments with ``lidargrit``, one a file."""

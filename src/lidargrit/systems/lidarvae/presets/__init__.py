"""Experiments with ``lidarvae``, one a file."""

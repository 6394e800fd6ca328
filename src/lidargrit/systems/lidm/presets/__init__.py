"""Experiments with ``lidm``, one a file."""

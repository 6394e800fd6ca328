"""Experiments with ``marginal``, one a file."""

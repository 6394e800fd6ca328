"""Experiments with ``multiscale``, one a file."""

"""Experiments with ``maskgit``, one a file."""

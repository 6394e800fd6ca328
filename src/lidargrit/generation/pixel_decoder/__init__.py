"""Mask and ranges with exact probabilities, in phases from coarse to fine."""

"""LiDAR scans in, tokens between, new scans out."""

__version__ = "0.1.0"

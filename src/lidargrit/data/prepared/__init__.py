"""Data sources → range images, projected once and kept on disk."""

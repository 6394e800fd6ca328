"""A trained run used: completed scans and compressed ones."""

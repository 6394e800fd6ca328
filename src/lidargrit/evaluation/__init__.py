"""Sample to disk, compare with real scans, score: a trained run → numbers."""

"""The system ``segmenter``; see system.py."""

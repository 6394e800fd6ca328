"""The system ``forecaster``; see system.py."""

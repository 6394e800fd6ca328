"""The system ``pyramid``; see system.py."""

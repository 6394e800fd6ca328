"""The system ``memorised``; see system.py."""

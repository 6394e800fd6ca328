"""The system ``r2dm``; see system.py."""

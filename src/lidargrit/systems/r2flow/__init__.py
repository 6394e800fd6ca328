"""The system ``r2flow``; see system.py."""

"""The system ``interpolation``; see system.py."""

"""The system ``raydrop``; see system.py."""

"""The system ``multiscale``; see system.py."""

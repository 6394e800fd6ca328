"""The system ``ultralidar``; see system.py."""

"""The system ``lidargen``; see system.py."""

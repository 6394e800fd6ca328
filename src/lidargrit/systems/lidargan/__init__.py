"""The system ``lidargan``; see system.py."""

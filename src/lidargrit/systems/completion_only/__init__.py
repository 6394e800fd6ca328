"""The system ``completion_only``; see system.py."""

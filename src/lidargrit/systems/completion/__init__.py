"""The system ``completion``; see system.py."""

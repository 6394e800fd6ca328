"""The system ``dusty``; see system.py."""

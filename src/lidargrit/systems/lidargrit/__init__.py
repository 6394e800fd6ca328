"""The system ``lidargrit``; see system.py."""

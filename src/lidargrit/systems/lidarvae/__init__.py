"""The system ``lidarvae``; see system.py."""

"""The system ``lidm``; see system.py."""

"""The system ``marginal``; see system.py."""

"""The system ``maskgit``; see system.py."""

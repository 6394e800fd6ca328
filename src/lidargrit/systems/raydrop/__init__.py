"""The network for raydrop."""

"""What a scan, a range image, a sensor and a condition are, and how one becomes another."""

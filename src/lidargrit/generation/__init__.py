"""What a generator is, and what several systems share and knows scans."""

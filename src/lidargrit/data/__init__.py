"""Where scans and images come from and go to: formats, data sets, sources, prepared scans, run folders."""

"""Generated scans against real ones: which scans, which metrics, what is kept of the real side, and the figures."""

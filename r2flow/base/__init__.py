"""The ground floor: what all parts stand on; it knows nothing of scans or flows."""

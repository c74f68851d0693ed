"""Sensors, projection, encoding, scan files: pure geometry, no learning."""

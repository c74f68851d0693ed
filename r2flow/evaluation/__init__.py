"""Evaluation of generated against real scans: sets, protocols, cached statistics, results."""

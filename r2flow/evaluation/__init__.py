"""Evaluation of generated against real scans: sets, protocols, statistics, results."""

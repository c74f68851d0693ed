"""Runs: their configs, their folders, and chains of them."""

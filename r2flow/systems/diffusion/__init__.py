"""Diffusions as in R2DM (Nakashima and Kurazume 2024)."""

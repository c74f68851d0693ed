"""Paths, times, losses, solvers: pure functions of tensors."""

"""Diffusion and score matching: schedules, objectives, samplers. Pure mathematics, the network is a function."""

"""Diffusion and score matching: schedules, objectives, samplers. Pure mathematics, the network is a function.

A diffusion mixes data x and noise eps, z_t = alpha_t x + sigma_t eps with alpha_t^2 + sigma_t^2 = 1.

Notation and time are those of the field (Kingma et al. 2021, "Variational diffusion models"): t = 0 is data and t = 1
is noise, the other way round than for a flow. What tells how noisy z_t is, and what networks are given as their time,
is its log-SNR, lambda_t = ln(alpha_t^2 / sigma_t^2), which falls with t.
"""

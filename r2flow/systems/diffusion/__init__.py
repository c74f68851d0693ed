"""Diffusion: schedules, objectives, samplers. The network is a function argument.

A diffusion mixes data x and noise eps, z_t = alpha_t x + sigma_t eps with alpha_t^2 + sigma_t^2 = 1.

Notation and time follow Kingma et al. (2021), "Variational diffusion models": t = 0 is data and t = 1 is noise, the
reverse of a flow. The noise level of z_t, and the time input of networks, is the log-SNR,
lambda_t = ln(alpha_t^2 / sigma_t^2), which decreases with t.
"""

"""LiDM: a diffusion of an autoencoder's latents (Ran et al. 2024)."""

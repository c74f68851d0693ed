"""Trained models: checkpoints, and what is done with them."""

"""Trained models: checkpoints, sampling, completion, export and the Hub."""

"""Adversarial training: losses, the R1 penalty, adaptive augmentation, relaxed masks and the rules of a run."""

"""Vanilla GAN, DUSty v1 and v2 (Nakashima and Kurazume 2021, 2023)."""

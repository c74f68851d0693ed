"""LiDARGen: annealed Langevin dynamics by a learned score (Zyrianov et al. 2022)."""

"""Figures: one file each; they read artifacts and nothing else."""

"""Loops in continuous time: an ODE under a sampled, held control."""

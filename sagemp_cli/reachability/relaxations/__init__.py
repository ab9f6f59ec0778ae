"""Relaxations, one file per operation: the tightest band that contains a function's graph, rounding included."""

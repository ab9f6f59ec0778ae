"""Backward linear bounds (CROWN), and the best of both directions."""

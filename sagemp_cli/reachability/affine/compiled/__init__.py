"""Affine arithmetic of loops whose steps are alike, on arrays."""

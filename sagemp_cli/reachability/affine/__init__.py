"""Forward affine arithmetic, the default propagator."""

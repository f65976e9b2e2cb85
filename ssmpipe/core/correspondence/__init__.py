"""Dense correspondence by B-spline reparameterization of minimal description length."""

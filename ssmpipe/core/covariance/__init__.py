"""Continuous covariance of a cohort of splines: quadrature, formulations I and II, exact composition."""

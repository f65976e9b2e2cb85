"""B-spline curves and surfaces: knots, basis, evaluation, fitting."""

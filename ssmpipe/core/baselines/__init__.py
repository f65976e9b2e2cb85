"""Reparameterization by long concatenations of small random warps: what the direct spline map is compared with."""

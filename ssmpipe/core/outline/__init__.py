"""Planar outlines: ordered points, open or closed."""

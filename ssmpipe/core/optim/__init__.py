"""Iterative solvers that know nothing of shapes."""

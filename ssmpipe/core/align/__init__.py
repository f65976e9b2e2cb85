"""Poses: anatomical frames, rigid motions, iterative closest point, Procrustes."""

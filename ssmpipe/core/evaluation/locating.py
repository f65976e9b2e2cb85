"""Nearest places on surfaces and curves alike."""

from __future__ import annotations

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.mesh.distance import point_to_mesh
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.outline.distance import point_to_segments


def locate(marks: Floats, points: Floats, faces: Ints) -> tuple[Floats, Ints, Floats]:
    """Return distance, index and barycentric coordinates of the nearest place on triangles, or on edges of a curve.

    Examples
    --------
    >>> import numpy as np
    >>> locate(np.array([[1.0, 1.0]]), np.array([[0, 0], [4.0, 0]]), np.array([[0, 1]]))[2]
    array([[0.75, 0.25]])
    """
    if faces.shape[1] == 2:
        return point_to_segments(marks, points, faces)
    return point_to_mesh(marks, TriMesh(points, faces))

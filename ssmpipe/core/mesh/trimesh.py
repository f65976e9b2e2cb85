"""The triangle mesh that all stages exchange."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmpipe.core.arrays import Floats, Ints, frozen
from ssmpipe.core.errors import GeometryError


@dataclass(frozen=True, eq=False)
class TriMesh:
    """Immutable triangle mesh, checked once at the door.

    Parameters
    ----------
    vertices : (n_vertices, 3) float64
        Positions [mm].
    faces : (n_faces, 3) int64
        Vertex indices, counter-clockwise seen from outside.

    Raises
    ------
    GeometryError
        If a shape is wrong, a coordinate is not finite, an index is out of range, or there are no faces.

    Examples
    --------
    >>> TriMesh(np.eye(3), np.array([[0, 1, 2]])).n_faces
    1
    """

    vertices: Floats
    faces: Ints

    def __post_init__(self) -> None:
        vertices = np.asarray(self.vertices, dtype=np.float64)
        faces = np.asarray(self.faces)
        if vertices.ndim != 2 or vertices.shape[1] != 3:
            raise GeometryError(f"vertices: got an array of shape {vertices.shape}, need (n_vertices, 3)")
        if faces.ndim != 2 or faces.shape[1] != 3:
            raise GeometryError(f"faces: got an array of shape {faces.shape}, need (n_faces, 3)")
        if len(faces) == 0:
            raise GeometryError("the mesh has no faces", "export a surface, not a point cloud")
        bad = ~np.isfinite(vertices).all(axis=1)
        if bad.any():
            raise GeometryError(
                f"{int(bad.sum())} of {len(vertices)} vertices have coordinates that are not finite (NaN or infinite)",
                "export the surface again from the segmentation",
            )
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise GeometryError(
                f"face index {int(faces.max() if faces.max() >= len(vertices) else faces.min())} is out of range: "
                f"the mesh has {len(vertices)} vertices"
            )
        object.__setattr__(self, "vertices", frozen(vertices, np.float64))
        object.__setattr__(self, "faces", frozen(faces, np.int64))

    @property
    def n_vertices(self) -> int:
        """Number of vertices."""
        return len(self.vertices)

    @property
    def n_faces(self) -> int:
        """Number of triangles."""
        return len(self.faces)

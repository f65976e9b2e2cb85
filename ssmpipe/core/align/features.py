"""Candidates for landmarks, from geometry: to be looked at, not to be trusted."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from ssmpipe.core.align.proximal_femur import ProximalFemur, analyze_proximal_femur
from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.mesh.curvature import principal_curvatures
from ssmpipe.core.mesh.distance import sample_surface
from ssmpipe.core.mesh.trimesh import TriMesh


class Candidate(NamedTuple):
    """A place on a surface and how strongly it has what was looked for: mm for dents and bulges, 1/mm for valleys."""

    point: Floats
    strength: float


def femur_candidates(mesh: TriMesh, found: ProximalFemur | None = None) -> dict[str, Candidate]:
    """Return candidates for ``fovea`` and ``lesser_trochanter`` of a femur.

    The fovea is the deepest dent of the head below the sphere that fits it, averaged over an eighth of the head's radius, on
    the side away from the neck. The trochanter: see :func:`ssmpipe.core.align.proximal_femur.analyze_proximal_femur`,
    whose result is ``found``, if that is known already.

    Raises
    ------
    GeometryError
        If the shape is no femur.
    """
    found = found or analyze_proximal_femur(mesh)
    points, _, _ = sample_surface(mesh, 40000)
    offset = points - found.head
    distance = np.linalg.norm(offset, axis=1)
    medial = found.head - found.origin
    medial = medial - (medial @ found.axis) * found.axis
    medial /= np.linalg.norm(medial)
    up = 0.8 * medial + 0.6 * found.axis
    on_head = (np.abs(distance / found.head_radius - 1.0) < 0.25) & (offset @ up > 0.35 * found.head_radius)
    if on_head.sum() < 50:
        raise GeometryError("the head of the femur has too little surface to look for the fovea", "check the scan")
    tree = cKDTree(points[on_head])
    near = tree.query_ball_point(points[on_head], 0.125 * found.head_radius)
    depth = (found.head_radius - distance)[on_head]
    sizes = np.array([len(n) for n in near])
    mean = np.add.reduceat(depth[np.concatenate(near)], np.r_[0, np.cumsum(sizes)[:-1]]) / sizes
    best = int(np.argmax(mean))
    return {
        "fovea": Candidate(points[on_head][best], float(mean[best])),
        "lesser_trochanter": Candidate(found.trochanter, found.bulge),
    }


def valley_candidates(mesh: TriMesh, n: int = 3, scale: float = 0.05) -> dict[str, Candidate]:
    """Return the places of the ``n`` sharpest valleys of a surface, as between the sinuses of an aortic root.

    A vertex lies in a valley where the smaller principal curvature is most negative within ``3 * scale`` of the size.

    Parameters
    ----------
    mesh : TriMesh
    n : int
    scale : float
        Radius of the neighbourhood for curvatures, in diagonals of the bounding box [-].
    """
    size = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    concave = -principal_curvatures(mesh, scale * size)[:, 1]
    chosen = _apart(mesh.vertices, concave, n, 3.0 * scale * size)
    return {f"valley_{k}": Candidate(mesh.vertices[v], float(concave[v])) for k, v in enumerate(chosen, start=1)}


def _apart(points: Floats, values: Floats, n: int, separation: float) -> Ints:
    """Return the indices of the n largest values, no two nearer to each other than ``separation``."""
    left = np.array(values, dtype=np.float64)
    found: list[int] = []
    for _ in range(n):
        best = int(np.argmax(left))
        if not np.isfinite(left[best]):
            break
        found.append(best)
        left[np.linalg.norm(points - points[best], axis=1) < separation] = -np.inf
    return np.array(found, dtype=np.int64)

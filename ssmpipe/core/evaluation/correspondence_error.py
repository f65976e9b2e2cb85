"""Error of a correspondence against a dense known truth."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.mesh.distance import point_to_mesh
from ssmpipe.core.mesh.trimesh import TriMesh


def correspondence_error(points: Floats, faces: Ints, truth: Floats, *, max_distance: float = 2.0) -> Floats:
    """Carry true points from every shape to every other one and return how far they land from where they belong.

    Parameters
    ----------
    points : (n_S, n_P, 3) float64
        Corresponded points [mm].
    faces : (n_F, 3) int64
    truth : (n_S, n_T, 3) float64
        Truly corresponding points, in the frame of ``points``.
    max_distance : float, default=2
        A true point farther than this from the corresponded surface of any shape (it was cut away) is left out [mm].

    Returns
    -------
    (n_S, n_S, n_kept) float64
        ``[i, j]``: carried from shape i, distance to the true point on shape j [mm]; the diagonal is the distance to the
        own surface.

    Examples
    --------
    >>> flat = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0.0]]])
    >>> truth = np.array([[[0.2, 0.2, 0.0]], [[0.2, 0.3, 0.0]]])
    >>> correspondence_error(np.repeat(flat, 2, axis=0), np.array([[0, 1, 2]]), truth)[0, 1].round(6)
    array([0.1])
    """
    places = [point_to_mesh(t, TriMesh(p, faces)) for p, t in zip(points, truth, strict=True)]
    kept = np.all([distance <= max_distance for distance, _, _ in places], axis=0)
    errors = np.empty((len(points), len(points), int(kept.sum())))
    for i, (_, face, weights) in enumerate(places):
        corners = faces[face[kept]]
        carried = np.einsum("tk,jtkd->jtd", weights[kept], points[:, corners])
        errors[i] = np.linalg.norm(carried - truth[:, kept], axis=-1)
    return errors

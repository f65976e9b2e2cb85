"""Align a cohort to itself: no shape is the reference."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial import cKDTree

from ssmpipe.core.align.icp import PointSurface, align, refine
from ssmpipe.core.align.medoid import medoid
from ssmpipe.core.align.rigid import apply, homogeneous, move, rotation_angle
from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.result import Result, Status


def align_group(
    meshes: Mapping[str, TriMesh],
    *,
    first: str | None = None,
    n_points: int = 1500,
    max_rounds: int = 15,
    tolerance_deg: float = 0.05,
) -> Result[dict[str, Floats]]:
    """Move every shape onto the union of all others, round by round.

    Starts from the poses relative to one shape. In every round each shape is refined against the points of all others in their
    poses of the round before; then the motion that is common to all is taken back, so that the group stays where it was. What
    the first shape has of its own in its pose fades: its part in every union is that of any other.

    Parameters
    ----------
    meshes : mapping of str to TriMesh
        At least three.
    first : str, optional
        The shape of the first round; the most central one by default.
    n_points : int
        Per surface.
    max_rounds : int
    tolerance_deg : float
        Converged when no shape turns more in a round [degrees].

    Returns
    -------
    Result of dict of str to (4, 4) float64
        Proper rigid motions; ``history["turned_deg"]`` is the largest turn of each round.

    Raises
    ------
    GeometryError
        If there are fewer than three shapes.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import star_shape
    >>> lump = star_shape(2)
    >>> away = homogeneous(np.diag([-1.0, -1.0, 1.0]), np.array([30.0, 0.0, 0.0]))
    >>> poses = align_group({"a": lump, "b": lump, "c": move(lump, away)}, first="a", n_points=400).value
    >>> bool(np.abs(poses["c"] @ away - poses["a"]).max() < 0.2)
    True
    """
    if len(meshes) < 3:
        raise GeometryError(f"a group needs three shapes, there are {len(meshes)}", "align to one of them instead")
    ids = sorted(meshes)
    reference = meshes[first if first is not None else medoid(meshes)]
    poses = {i: align(meshes[i], reference, n_points=n_points).matrix for i in ids}
    surfaces = {i: PointSurface.of(meshes[i], n_points) for i in ids}
    turned: list[float] = []
    status: Status = "out-of-iterations"
    for _ in range(max_rounds):
        new = {}
        for i in ids:
            points = np.vstack([apply(poses[j], surfaces[j].points) for j in ids if j != i])
            normals = np.vstack([surfaces[j].normals @ poses[j][:3, :3].T for j in ids if j != i])
            new[i] = refine(surfaces[i], PointSurface(points, normals, cKDTree(points)), poses[i], 8)[0]
        common = np.linalg.inv(_mean_motion([new[i] @ np.linalg.inv(poses[i]) for i in ids]))
        new = {i: common @ new[i] for i in ids}
        turned.append(max(rotation_angle(new[i] @ np.linalg.inv(poses[i])) for i in ids))
        poses = new
        if turned[-1] < tolerance_deg:
            status = "converged"
            break
    return Result(poses, status, len(turned), history={"turned_deg": np.array(turned)})


def union(meshes: Mapping[str, TriMesh], poses: Mapping[str, Floats]) -> TriMesh:
    """Return all shapes in their (4, 4) poses as one mesh of as many pieces, in the order of ``meshes``.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import sphere
    >>> ball = sphere(1.0, 1)
    >>> both = union({"a": ball, "b": ball}, {"a": np.eye(4), "b": homogeneous(np.eye(3), np.array([5.0, 0, 0]))})
    >>> both.n_faces == 2 * ball.n_faces, round(float(both.vertices[ball.n_vertices :, 0].mean()), 6)
    (True, 5.0)
    """
    pieces = [move(mesh, poses[i]) for i, mesh in meshes.items()]
    offsets = np.cumsum([0] + [piece.n_vertices for piece in pieces[:-1]])
    faces = np.vstack([piece.faces + offset for piece, offset in zip(pieces, offsets, strict=True)])
    return TriMesh(np.vstack([piece.vertices for piece in pieces]), faces)


def _mean_motion(motions: list[Floats]) -> Floats:
    """Return the rotation nearest to the mean of the rotations (chordal), with the mean translation."""
    u, _, vt = np.linalg.svd(np.mean([m[:3, :3] for m in motions], axis=0))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return homogeneous(rotation, np.mean([m[:3, 3] for m in motions], axis=0))

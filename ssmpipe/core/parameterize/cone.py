"""Map a cap or a closed surface to the square by its poles, with period 1 in u and little stretch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import FoldoverError, TopologyError
from ssmpipe.core.mesh.distance import point_to_mesh
from ssmpipe.core.mesh.topology import boundary_loops
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.parameterize.boundary import rim_of, split_chords
from ssmpipe.core.parameterize.cutting import Opened, cut_along, shortest_path
from ssmpipe.core.parameterize.distortion import signed_uv_areas
from ssmpipe.core.parameterize.periodic import (
    Wrapped,
    folded_periodic,
    harmonic_weights,
    relax,
    solve_periodic,
    wrap,
)
from ssmpipe.core.parameterize.poles import insert_point
from ssmpipe.core.parameterize.remap import remap_periodic
from ssmpipe.core.parameterize.seam import Seam

# smallest weight of an edge where no triangle may fold, as a share of the mean one
FLOOR = 1e-2
Y_AXIS = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True, eq=False)
class PoleMap:
    """A map between poles.

    Attributes
    ----------
    mesh : TriMesh
        Cut open along the seam.
    uv : (n_vertices, 2) float64
    seam : Seam
    stretch : (n,) float64
        Of the harmonic map, after each round of relaxation, and after the changes of u and v alone.
    n_rounds : int
        Rounds of relaxation.
    settled : bool
        Whether the relaxation ended because the stretch fell no more.
    n_folds_harmonic : int
        Triangles that the plain harmonic weights turn over; above zero, negative weights were raised.
    ring_before, ring : (n_poles,) float64
        Share of v that the faces around each pole span, in the harmonic map and in the end.
    kink : float
        Slope of u behind the opposite line of :mod:`~ssmpipe.core.parameterize.traced` by that before it, on the mean along it;
        1 for maps without such a line.
    """

    mesh: TriMesh
    uv: Floats
    seam: Seam
    stretch: Floats
    n_rounds: int
    settled: bool
    n_folds_harmonic: int
    ring_before: Floats
    ring: Floats
    kink: float = 1.0


def parameterize_poles(
    mesh: TriMesh,
    apex: Floats,
    antapex: Floats | None = None,
    *,
    seam_point: Floats | None = None,
    seam_direction: Floats | None = None,
    eta: float = 0.5,
    max_iterations: int = 50,
    n_remap: int = 10,
) -> PoleMap:
    """Map a surface one-to-one to the square [0, 1)^2, periodic in u, from its rim or antapex (v = 0) to its apex (v = 1).

    1. u and v are harmonic (Li 2015, section 5.2.4; here u is one solve with a jump of 1 across the seam instead of two regions).
       Where negative cotangent weights turn a triangle over they are raised to a small positive value, which excludes folds.
    2. The stretch is relaxed from positive weights (:func:`~ssmpipe.core.parameterize.periodic.relax`).
    3. u and v are changed by one function each (:func:`~ssmpipe.core.parameterize.remap.remap_periodic`).
    4. u is shifted so that u = 0 runs through ``seam_point``, or on the side of ``seam_direction``: there the first harmonic in u of
       the coordinate along it is largest. The whole surface decides, not one vertex.

    Parameters
    ----------
    mesh : TriMesh
        With one boundary loop, or closed when ``antapex`` is given.
    apex, antapex : (3,) float64
        The poles; the nearest places of the surface become vertices [mm].
    seam_point : (3,) float64, optional
    seam_direction : (3,) float64, optional
        In the aligned frame; y by default.
    eta, max_iterations
        Of the relaxation; no round at all leaves the harmonic map.
    n_remap : int
        Coefficients of the changes of u and of v; 0 makes none.

    Returns
    -------
    PoleMap

    Raises
    ------
    TopologyError
        If the surface has another number of boundary loops.
    FoldoverError
        If a triangle is turned over; says how many and where.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import sphere
    >>> ball = parameterize_poles(sphere(10.0), np.array([0, 0, 10.0]), np.array([0, 0, -10.0]))
    >>> middle = abs(ball.mesh.vertices[:, 2]) < 1e-9
    >>> bool(abs(ball.uv[middle, 1] - 0.5).max() < 1e-2)
    True
    """
    wrapped = _cut(mesh, apex, antapex)
    opened = wrapped.opened.mesh
    weights = harmonic_weights(TriMesh(opened.vertices, wrapped.opened.origin[opened.faces]), wrapped.edges)
    positive = np.maximum(weights, FLOOR * float(np.abs(weights).mean()))
    harmonic = solve_periodic(wrapped, weights)
    n_folds = int(folded_periodic(opened, harmonic, wrapped.poles).sum())
    if n_folds:
        harmonic = solve_periodic(wrapped, positive)
    relaxed = relax(wrapped, positive, harmonic, eta=eta, max_iterations=max_iterations)
    stretch = relaxed.history["stretch"]

    def placed(uv: Floats) -> Floats:
        if seam_point is not None:
            return uv - [u_at(opened, uv, seam_point), 0.0]
        return uv - [u_towards(opened, uv, wrapped.poles, Y_AXIS if seam_direction is None else seam_direction), 0.0]

    found = finished(wrapped.opened, wrapped.poles, harmonic, relaxed.value, stretch, placed, n_remap)
    return replace(
        found, n_rounds=relaxed.n_iterations, settled=relaxed.status == "converged", n_folds_harmonic=n_folds
    )


def finished(
    opened: Opened,
    poles: tuple[int, ...],
    harmonic: Floats,
    uv: Floats,
    stretch: Floats,
    placed: Callable[[Floats], Floats],
    n_remap: int,
    remedy: str = "",
) -> PoleMap:
    """Put u = 0 in its place, change u and v by one function each, refuse folds, and say what the map is like.

    Parameters
    ----------
    opened : Opened
    poles : tuple of int
    harmonic, uv : (n_vertices, 2) float64
        The first map and the last one.
    stretch : (n,) float64
        From the first map to the last one.
    placed : function
        Shifts u so that u = 0 lies where it should.
    n_remap : int
        Coefficients of the changes of u and of v; 0 makes none.
    remedy : str
        For folds.

    Raises
    ------
    FoldoverError
        If a triangle is turned over.
    """
    # before the remap as well: its knots count from u = 0
    uv = placed(uv)
    if n_remap:
        uv, after = remap_periodic(opened.mesh, uv, poles, n_coefficients=n_remap)
        uv, stretch = placed(uv), np.append(stretch, after[-1])
    refuse_folds(opened.mesh, uv, poles, remedy)
    before, ring = (pole_rings(opened.mesh, field, poles) for field in (harmonic, uv))
    seam = Seam("closed" if len(poles) == 2 else "cone", opened.pairs, poles)
    return PoleMap(opened.mesh, uv, seam, stretch, 0, True, 0, before, ring)


def u_at(mesh: TriMesh, uv: Floats, point: Floats) -> float:
    """Return u at the place of the surface that is nearest to a point."""
    _, face, weights = point_to_mesh(np.asarray(point, dtype=np.float64)[None], mesh)
    return float(weights[0] @ uv[mesh.faces[face[0]], 0])


def u_towards(mesh: TriMesh, uv: Floats, poles: tuple[int, ...], direction: Floats) -> float:
    """Return the u on the side of a direction: the phase of the first harmonic in u of the coordinate along it."""
    plain = mesh.faces[~np.isin(mesh.faces, poles).any(axis=1)]
    weight = signed_uv_areas(uv, plain)
    height = (mesh.vertices @ direction)[plain].mean(axis=1)
    height -= weight @ height / weight.sum()
    harmonic = (weight * height) @ np.exp(2j * np.pi * uv[plain, 0].mean(axis=1))
    return float(np.angle(harmonic) / (2.0 * np.pi))


def _cut(mesh: TriMesh, apex: Floats, antapex: Floats | None) -> Wrapped:
    n_loops = len(boundary_loops(mesh.faces))
    poles: tuple[int, ...]
    if antapex is not None:
        if n_loops:
            raise TopologyError(
                f"the surface has {n_loops} boundary loops, a closed one is needed",
                "use topology: cone, or fill the holes",
            )
        mesh, top = insert_point(mesh, apex)
        mesh, start = insert_point(mesh, antapex)
        if start == top:
            raise TopologyError("apex and antapex are the same place", "choose landmarks at opposite ends")
        bottom, poles = np.array([start]), (start, top)
    else:
        rim_of(mesh)
        mesh = split_chords(mesh)
        mesh, top = insert_point(mesh, apex)
        bottom, poles = rim_of(mesh), (top,)
    path = shortest_path(mesh, top, bottom, np.zeros(0, dtype=np.int64))[::-1]
    return wrap(cut_along(mesh, path, poles), bottom, np.array([top]), poles)


def pole_rings(mesh: TriMesh, uv: Floats, poles: tuple[int, ...]) -> Floats:
    """Return the mean share of v between each pole and its neighbours, (n_poles,).

    Examples
    --------
    >>> fan = TriMesh(np.eye(3), np.array([[0, 1, 2]]))
    >>> pole_rings(fan, np.array([[0.0, 0.75], [1.0, 0.75], [0.5, 1.0]]), (2,))
    array([0.25])
    """
    shares = []
    for pole in poles:
        around = np.setdiff1d(mesh.faces[(mesh.faces == pole).any(axis=1)], [pole])
        shares.append(float(np.abs(uv[around, 1] - uv[pole, 1]).mean()))
    return np.array(shares)


def refuse_folds(mesh: TriMesh, uv: Floats, poles: tuple[int, ...], remedy: str = "") -> None:
    """Raise an error with the number of triangles that are turned over, and the place of the first one."""
    bad = np.flatnonzero(folded_periodic(mesh, uv, poles))
    if len(bad):
        x, y, z = mesh.vertices[mesh.faces[bad[0]]].mean(axis=0)
        raise FoldoverError(
            f"{len(bad)} of {mesh.n_faces} triangles are turned over in the square, the first at ({x:.1f}, {y:.1f}, {z:.1f}) mm",
            remedy or "smooth or decimate the mesh first, it has slivers",
        )

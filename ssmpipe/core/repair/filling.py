"""Close holes of a surface with patches that continue its curvature."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.mesh.operators import edge_lengths, vertex_normals
from ssmpipe.core.mesh.topology import boundary_half_edges, unique_edges
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.holes import check_loops, delaunay_flips, folded_share, round_patch, started_by_shape
from ssmpipe.core.repair.patch_fairing import (
    ImplicitSurface,
    biharmonic,
    fading,
    membrane,
    noise_level,
    relaxed,
    thinned,
)
from ssmpipe.core.repair.smoothing import taubin

Method = Literal["auto", "implicit", "biharmonic", "membrane"]

FOLDED = 0.03
"""Share of a patch's area that may face away from its surroundings: single faces in the teeth of a ragged rim [-]."""

N_NODES, REACH, OFFSET, SMOOTHING = 350, 0.4, 0.075, 0.01
"""Of the implicit surface: number of points, how far from the rim they may lie and where points off the surface lie [widths of the
hole], smoothing. Found on a tube with sinuses with holes of 4 and 7 mm radius (benchmarks/fill_holes.py)."""


@dataclass(frozen=True)
class Patch:
    """What was put into one hole.

    Attributes
    ----------
    middle : tuple of float
        Mean of the loop's vertices [mm].
    length, width : float
        Length of the loop, and the largest distance of two of its vertices [mm].
    radius : float
        Of the sphere that fits the surroundings best [mm].
    method : str
    noise : float
        Estimated noise of the surface around the hole [mm].
    n_vertices, n_faces : int
        What was added.
    """

    middle: tuple[float, float, float]
    length: float
    width: float
    radius: float
    method: str
    noise: float
    n_vertices: int
    n_faces: int


def fill(
    mesh: TriMesh, loops: list[Ints], *, method: Method = "auto", n_smooth: int = 20
) -> tuple[TriMesh, list[Patch]]:
    """Close boundary loops with smooth patches.

    Each patch is made and shaped within a band around its hole, so the time does not depend on the size of the mesh. What the
    patch continues is a smoothed copy of that band; the vertices of the mesh themselves stay to the bit.

    Parameters
    ----------
    mesh : TriMesh
        Oriented and manifold.
    loops : list of (n,) int64
        As :func:`ssmpipe.core.mesh.topology.boundary_loops` gives them.
    method : {"auto", "implicit", "biharmonic", "membrane"}
        "implicit" continues curvature across wide holes and through noise; "biharmonic" is smooth at the rim and follows it;
        "membrane" is the flattest. "auto" takes biharmonic for holes that are narrow for the mesh, and implicit otherwise.
    n_smooth : int
        Taubin iterations on the copy [count].

    Returns
    -------
    mesh : TriMesh
        Old vertices and faces first.
    patches : list of Patch
        In the order of ``loops``.

    Raises
    ------
    TopologyError
        If loops touch.
    GeometryError
        If a patch would be folded: names the place.
    """
    check_loops(mesh)
    vertices, faces, patches = [mesh.vertices], [mesh.faces], []
    n = mesh.n_vertices
    for loop in loops:
        points, triangles, patch = _patch(mesh, loop, method, n_smooth)
        ring = loop[::-1][started_by_shape(mesh.vertices[loop[::-1]])]
        number = np.r_[ring, n + np.arange(len(points))]
        vertices.append(points)
        faces.append(number[triangles])
        patches.append(patch)
        n += len(points)
    return TriMesh(np.vstack(vertices), np.vstack(faces)), patches


def _patch(mesh: TriMesh, loop: Ints, method: Method, n_smooth: int) -> tuple[Floats, Ints, Patch]:
    """Return the new vertices, the triangles over (loop by shape, new vertices), and the record."""
    loop = loop[::-1]
    loop = loop[started_by_shape(mesh.vertices[loop])]
    rim = mesh.vertices[loop]
    sides = np.linalg.norm(np.roll(rim, -1, axis=0) - rim, axis=1)
    width = float(np.linalg.norm(rim - rim.mean(axis=0), axis=1).max() * 2)
    band, old = _band(mesh, loop, width)
    where = np.full(mesh.n_vertices, -1)
    where[old] = np.arange(len(old))
    ring = where[loop]
    spacing = float(np.median(edge_lengths(band, unique_edges(band.faces).vertices)))
    wanted = spacing
    smooth = taubin(band, n_iterations=n_smooth)
    whole = np.ones(band.n_vertices, dtype=bool)
    whole[boundary_half_edges(band.faces)] = False
    noise = noise_level(band, smooth, whole)
    chosen = method
    if method == "auto":
        chosen = "biharmonic" if width < 6 * spacing or whole.sum() < 100 else "implicit"
    for _ in range(3):
        flat, triangles = round_patch(sides, spacing)
        n_new = len(flat) - len(loop)
        number = np.r_[ring, band.n_vertices + np.arange(n_new)]
        middle = np.tile(rim.mean(axis=0), (n_new, 1))
        joint = TriMesh(np.vstack([smooth.vertices, middle]), np.vstack([band.faces, number[triangles]]))
        free = np.arange(joint.n_vertices) >= band.n_vertices
        vertices = membrane(joint, free) if n_new else joint.vertices
        if n_new == 0 or chosen == "membrane":
            break
        full = np.r_[whole, np.ones(n_new, dtype=bool)]
        full[ring] = True
        for _ in range(2):
            triangles = delaunay_flips(vertices[number], triangles, len(loop))
            joint = TriMesh(vertices, np.vstack([band.faces, number[triangles]]))
            vertices = biharmonic(joint, free, full, n_rounds=2)
        edges = unique_edges(triangles).vertices
        mean = float(np.linalg.norm(np.diff(vertices[number][edges], axis=1), axis=2).mean())
        if mean < 1.2 * wanted:
            break
        spacing *= wanted / mean
    points = vertices[free]
    if n_new:
        # the patch continues the smoothed copy; near the rim it goes over to the vertices as they are
        points = points + fading(triangles, rim - smooth.vertices[ring], len(number), 1.5)[len(loop) :]
        surface = _surface_around(smooth, ring, width) if chosen == "implicit" else None
        for _ in range(3):
            points = relaxed(np.vstack([rim, points]), triangles, len(loop), 6)[len(loop) :]
            if surface is not None:
                points = surface.project(points, 3)
            triangles = delaunay_flips(np.vstack([rim, points]), triangles, len(loop))
        if surface is not None:
            points = points + fading(triangles, rim - surface.project(rim, 4), len(number), 1.5)[len(loop) :]
    _check_patch(np.vstack([rim, points]), triangles, float(sides.sum()), rim.mean(axis=0))
    x, y, z = (float(c) for c in rim.mean(axis=0))
    record = Patch(
        (x, y, z), float(sides.sum()), width, _sphere_radius(smooth.vertices), chosen, noise, n_new, len(triangles)
    )
    return points, triangles, record


def _sphere_radius(points: Floats) -> float:
    """Return the radius of the best sphere; infinite for a plane [mm]."""
    centred = points - points.mean(axis=0)
    system = np.column_stack([2 * centred, np.ones(len(points))])
    solution, _, rank, _ = np.linalg.lstsq(system, (centred**2).sum(axis=1), rcond=1e-9)
    square = float(solution[3] + solution[:3] @ solution[:3])
    return float(np.sqrt(square)) if rank == 4 and square > 0 else float("inf")


def _check_patch(vertices: Floats, triangles: Ints, length: float, middle: Floats) -> None:
    share = folded_share(vertices, triangles)
    if share > FOLDED or not np.isfinite(vertices).all():
        x, y, z = middle
        raise GeometryError(
            f"the patch for the hole of {length:.1f} mm at ({x:.1f}, {y:.1f}, {z:.1f}) mm would be folded "
            f"({100 * share:.0f} % of its area)",
            "smooth the rim or close the hole in the segmentation",
        )


def _spacing(mesh: TriMesh) -> float:
    return float(np.median(edge_lengths(mesh, unique_edges(mesh.faces).vertices)))


def _surface_around(smooth: TriMesh, ring: Ints, width: float) -> ImplicitSurface:
    """Return the surface through what lies around the hole, without the rim itself, which smoothing distorts."""
    apart = cKDTree(smooth.vertices[ring]).query(smooth.vertices)[0]
    near = np.flatnonzero((apart < REACH * width) & (apart > 1.5 * _spacing(smooth)))
    near = near[thinned(smooth.vertices[near], N_NODES)]
    return ImplicitSurface(smooth.vertices[near], vertex_normals(smooth)[near], OFFSET * width, SMOOTHING)


def _band(mesh: TriMesh, loop: Ints, width: float) -> tuple[TriMesh, Ints]:
    """Return the faces around a loop that are joined to it, and the old indices of their vertices."""
    edge = mesh.vertices[loop] - mesh.vertices[np.roll(loop, -1)]
    reach = max(0.6 * width, 12 * float(np.linalg.norm(edge, axis=1).mean()))
    low, high = mesh.vertices[loop].min(axis=0) - reach, mesh.vertices[loop].max(axis=0) + reach
    boxed = np.flatnonzero(((mesh.vertices > low) & (mesh.vertices < high)).all(axis=1))
    near = np.zeros(mesh.n_vertices, dtype=bool)
    near[boxed] = cKDTree(mesh.vertices[loop]).query(mesh.vertices[boxed])[0] < reach
    near[loop] = True
    kept = np.flatnonzero(near[mesh.faces].any(axis=1))
    faces = mesh.faces[kept]
    used, local = np.unique(faces, return_inverse=True)
    local = local.reshape(-1, 3)
    i, j = local.ravel(), np.roll(local, -1, axis=1).ravel()
    label = csgraph.connected_components(
        sparse.csr_matrix((np.ones(len(i)), (i, j)), shape=(len(used),) * 2), directed=False
    )[1]
    start = label[np.searchsorted(used, loop[0])]
    mine = label[local[:, 0]] == start
    old = np.unique(faces[mine])
    return TriMesh(mesh.vertices[old], np.searchsorted(old, faces[mine])), old

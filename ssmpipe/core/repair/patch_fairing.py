"""The shape of a patch: as smooth as what surrounds it, curvature included, also where that is noisy."""

from __future__ import annotations

import igl
import numpy as np
from scipy import linalg, sparse
from scipy.sparse.linalg import splu
from scipy.spatial.distance import cdist

from ssmpipe.core.arrays import Bools, Floats, Ints
from ssmpipe.core.mesh.operators import vertex_normals
from ssmpipe.core.mesh.trimesh import TriMesh


def membrane(mesh: TriMesh, free: Bools) -> Floats:
    """Return all positions with the ``free`` vertices in the middle of their neighbours, (n_vertices, 3) [mm]."""
    i, j = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    n = mesh.n_vertices
    matrix = sparse.csr_matrix((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), shape=(n, n))
    matrix.data[:] = 1.0
    laplacian = sparse.csr_matrix(sparse.diags(np.asarray(matrix.sum(axis=1)).ravel()) - matrix)
    return _solve(laplacian, mesh.vertices, free)


def biharmonic(mesh: TriMesh, free: Bools, full: Bools, n_rounds: int = 4) -> Floats:
    """Return positions that minimize the integral of the squared Laplacian, (n_vertices, 3) [mm].

    Botsch and Kobbelt (2004), order k = 2, with cotangent weights that are computed anew ``n_rounds`` times.

    Parameters
    ----------
    mesh : TriMesh
        The patch and at least two rings around it, with a first guess of the patch.
    free : (n_vertices,) bool
        The patch; all other vertices stay.
    full : (n_vertices,) bool
        Vertices whose faces are all in ``mesh``: only there the Laplacian is meant.
    n_rounds : int
    """
    vertices = np.array(mesh.vertices)
    faces = np.ascontiguousarray(mesh.faces)
    for _ in range(n_rounds):
        stiffness = igl.cotmatrix(vertices, faces)
        mass = np.asarray(igl.massmatrix(vertices, faces, igl.MASSMATRIX_TYPE_BARYCENTRIC).diagonal())
        # slivers of marching cubes have next to no mass
        inverse = np.where(full, 1.0 / np.maximum(mass, 0.1 * np.median(mass)), 0.0)
        vertices = _solve(sparse.csr_matrix(stiffness.T @ sparse.diags(inverse) @ stiffness), vertices, free)
    return vertices


def fading(faces: Ints, fixed: Floats, n_vertices: int, reach: float) -> Floats:
    """Carry values at the first vertices over into a patch, where they fade within about ``reach`` edges.

    Parameters
    ----------
    faces : (n_faces, 3) int64
    fixed : (n, k) float64
        Values at the first ``n`` vertices.
    n_vertices : int
    reach : float
        [edges]

    Returns
    -------
    (n_vertices, k) float64
    """
    i, j = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    matrix = sparse.csr_matrix((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), shape=(n_vertices,) * 2)
    matrix.data[:] = 1.0
    degree = np.asarray(matrix.sum(axis=1)).ravel()
    system = sparse.csr_matrix(sparse.diags(degree * (1 + 1 / (6 * reach**2))) - matrix)
    free = np.arange(n_vertices) >= len(fixed)
    return _solve(system, np.vstack([fixed, np.zeros((n_vertices - len(fixed), fixed.shape[1]))]), free)


def relaxed(vertices: Floats, faces: Ints, n_fixed: int, n_rounds: int) -> Floats:
    """Move the vertices after the first ``n_fixed`` along the surface towards the middle of their neighbours."""
    i, j = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    matrix = sparse.csr_matrix((np.ones(2 * len(i)), (np.r_[i, j], np.r_[j, i])), shape=(len(vertices),) * 2)
    average = sparse.csr_matrix(sparse.diags(1 / np.asarray(matrix.sum(axis=1)).ravel()) @ matrix)
    result = np.array(vertices)
    for _ in range(n_rounds):
        normal = vertex_normals(TriMesh(result, faces))
        step = average @ result - result
        step -= np.einsum("ij,ij->i", step, normal)[:, None] * normal
        result[n_fixed:] += 0.5 * step[n_fixed:]
    return result


def _solve(matrix: sparse.csr_matrix, values: Floats, free: Bools) -> Floats:
    rows = matrix[free]
    left = sparse.csc_matrix(rows[:, free])
    result = np.array(values)
    result[free] = splu(left, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(
        -(rows[:, ~free] @ values[~free])
    )
    return result


class ImplicitSurface:
    """A function that vanishes on a set of oriented points: a quadric plus radial functions ``r^3``, smoothed.

    The quadric carries the curvature across a hole, the radial part what differs from it (Carr et al. 2001, with quadratic
    polynomials and offset points).

    Parameters
    ----------
    points, normals : (n, 3) float64
    offset : float
        Distance of the points off the surface, where the function is plus and minus this [mm].
    smoothing : float
        Weight of smoothness against the points [-]; 0 passes through all.
    """

    def __init__(self, points: Floats, normals: Floats, offset: float, smoothing: float) -> None:
        self._middle = points.mean(axis=0)
        self._scale = float(np.sqrt(((points - self._middle) ** 2).sum(axis=1).mean()))
        step = offset / self._scale
        on = (points - self._middle) / self._scale
        self._nodes = np.vstack([on, on + step * normals, on - step * normals])
        n = len(self._nodes)
        value = np.repeat([0.0, step, -step], len(on))
        kernel = cdist(self._nodes, self._nodes) ** 3
        kernel[np.diag_indices(n)] += smoothing
        tail = _quadratic(self._nodes)
        system = np.block([[kernel, tail], [tail.T, np.zeros((tail.shape[1],) * 2)]])
        self._weights = linalg.solve(system, np.r_[value, np.zeros(tail.shape[1])], assume_a="sym")

    def project(self, points: Floats, n_steps: int = 8) -> Floats:
        """Return where the surface is met from ``points`` (m, 3) along the function's gradient (m, 3) [mm]."""
        at = (points - self._middle) / self._scale
        n = len(self._nodes)
        for _ in range(n_steps):
            offset = at[:, None, :] - self._nodes[None]
            r = np.linalg.norm(offset, axis=2)
            value = r**3 @ self._weights[:n] + _quadratic(at) @ self._weights[n:]
            slope = 3 * np.einsum("ij,ijk,j->ik", r, offset, self._weights[:n])
            slope += np.einsum("ijk,j->ik", _quadratic_slope(at), self._weights[n:])
            at = at - (value / np.maximum((slope**2).sum(axis=1), 1e-3))[:, None] * slope
        return np.asarray(at * self._scale + self._middle)


def _quadratic(p: Floats) -> Floats:
    x, y, z = p.T
    return np.column_stack([np.ones(len(p)), x, y, z, x * x, y * y, z * z, x * y, y * z, z * x])


def _quadratic_slope(p: Floats) -> Floats:
    x, y, z = p.T
    zero, one = np.zeros(len(p)), np.ones(len(p))
    dx = [zero, one, zero, zero, 2 * x, zero, zero, y, zero, z]
    dy = [zero, zero, one, zero, zero, 2 * y, zero, x, z, zero]
    dz = [zero, zero, zero, one, zero, zero, 2 * z, zero, y, x]
    return np.stack([np.stack(d, axis=1) for d in (dx, dy, dz)], axis=2)


def thinned(points: Floats, n: int) -> Ints:
    """Return ``n`` indices spread evenly, each the farthest from those before; the first the farthest from the middle."""
    if len(points) <= n:
        return np.arange(len(points))
    chosen = [int(np.argmax(((points - points.mean(axis=0)) ** 2).sum(axis=1)))]
    apart = ((points - points[chosen[0]]) ** 2).sum(axis=1)
    for _ in range(n - 1):
        chosen.append(int(np.argmax(apart)))
        apart = np.minimum(apart, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
    return np.array(chosen)


def noise_level(mesh: TriMesh, smooth: TriMesh, inside: Bools) -> float:
    """Return the root mean square distance of vertices from their smoothed places, along the normals [mm]."""
    away = np.einsum("ij,ij->i", mesh.vertices - smooth.vertices, vertex_normals(smooth))[inside]
    return float(np.sqrt((away**2).mean())) if len(away) else 0.0

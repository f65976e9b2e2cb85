"""Where shapes differ: signed distance along the normals of the mean, and tests at every point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.mesh.operators import vertex_normals
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.statistics.covariates import Contrast
from ssmpipe.core.statistics.false_discovery import false_discovery_rate
from ssmpipe.core.statistics.hotelling import permutation_test
from ssmpipe.core.statistics.permutation import Draws


@dataclass(frozen=True, eq=False)
class PointTests:
    """p values at every point.

    Parameters
    ----------
    p : (n_P,) float64
        Of each point alone.
    q : (n_P,) float64
        False discovery rate over all points.
    p_family : (n_P,) float64
        Chance of one false point anywhere (max-T).
    """

    p: Floats
    q: Floats
    p_family: Floats


def point_tests(values: Floats, contrast: Contrast, draws: Draws) -> PointTests:
    """Test the groups at every point: ``values`` (n, n_P) signed distances, or (n, n_P, d) coordinates (T2 per point).

    Copies of one point (a pole is stored once per grid row) count once in the correction. A point that does not vary gets 1.
    """
    stacked = values.reshape(*values.shape[:2], -1)
    _, first, copy = np.unique(
        np.moveaxis(stacked, 1, 0).reshape(values.shape[1], -1), axis=0, return_index=True, return_inverse=True
    )
    result = permutation_test(np.ascontiguousarray(stacked[:, first]), contrast, draws)
    p, p_family = (np.nan_to_num(x, nan=1.0) for x in (result.p, result.p_family))
    back = copy.ravel()
    return PointTests(p[back], false_discovery_rate(p)[back], p_family[back])


def outward_normals(mean: Floats, faces: Ints, *, closed: bool = False) -> Floats:
    """Return unit normals of a mean shape, (n_P, d).

    Parameters
    ----------
    mean : (n_P, d) float64
        Surface in space, or planar curve.
    faces : (n_F, 3) int64
        Empty for a curve.
    closed : bool
        Whether the curve is closed: then normals point out of it; along an open curve they point to its right.

    Raises
    ------
    ValueError
        For a curve in space, which has no side.

    Examples
    --------
    >>> outward_normals(np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]), np.empty((0, 3), dtype=np.int64), closed=True)[0].round(3)
    array([-0.707, -0.707])
    """
    if len(faces):
        _, first, copy = np.unique(mean, axis=0, return_index=True, return_inverse=True)
        normals = vertex_normals(TriMesh(mean[first], copy.ravel()[faces]))
        return np.asarray(normals[copy.ravel()])
    if mean.shape[1] != 2:
        raise ValueError("a curve in space has no outward side")
    if closed:
        tangent = np.roll(mean, -1, axis=0) - np.roll(mean, 1, axis=0)
        following = np.roll(mean, -1, axis=0)
        turn = np.sign((mean[:, 0] * following[:, 1] - mean[:, 1] * following[:, 0]).sum()) or 1.0
    else:
        tangent, turn = np.gradient(mean, axis=0), 1.0
    right = turn * np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
    length = np.linalg.norm(right, axis=1, keepdims=True)
    return np.divide(right, length, out=np.zeros_like(right), where=length > 0)


def signed_distances(points: Floats, mean: Floats, normals: Floats) -> Floats:
    """Return displacements from the mean along its normals, positive outward (the shell distance of Li 2015, figure 5.20).

    Parameters
    ----------
    points : (..., n_P, d) float64
    mean, normals : (n_P, d) float64

    Returns
    -------
    (..., n_P) float64

    Examples
    --------
    >>> signed_distances(np.array([[[0.0, 3.0]]]), np.array([[0.0, 1.0]]), np.array([[0.0, 1.0]]))
    array([[2.]])
    """
    return np.asarray(np.einsum("...ld,ld->...l", points - mean, normals))

"""Homogeneous (4, 4) matrices of rigid motions and reflections."""

from __future__ import annotations

from itertools import permutations, product

import numpy as np

from ssmpipe.core.align.procrustes import rotation_between
from ssmpipe.core.arrays import Floats
from ssmpipe.core.mesh.trimesh import TriMesh


def homogeneous(linear: Floats, translation: Floats) -> Floats:
    """Return the (4, 4) matrix of ``x -> linear x + translation``."""
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    matrix[:3, 3] = translation
    return matrix


def apply(matrix: Floats, points: Floats) -> Floats:
    """Move points (n, 3) by a (4, 4) matrix.

    Examples
    --------
    >>> apply(homogeneous(np.eye(3), np.array([1.0, 0, 0])), np.zeros((1, 3)))
    array([[1., 0., 0.]])
    """
    return np.asarray(points @ matrix[:3, :3].T + matrix[:3, 3])


def move(mesh: TriMesh, matrix: Floats) -> TriMesh:
    """Move a mesh; a reflection turns the faces around so that normals keep pointing outward."""
    mirrored = np.linalg.det(matrix[:3, :3]) < 0
    return TriMesh(apply(matrix, mesh.vertices), mesh.faces[:, ::-1] if mirrored else mesh.faces)


def reflection(axis: int = 0) -> Floats:
    """Return the (4, 4) matrix that negates one coordinate."""
    matrix = np.eye(4)
    matrix[axis, axis] = -1.0
    return matrix


def rotation_angle(rotation: Floats) -> float:
    """Return the angle of a (3, 3) or (4, 4) rotation [degrees], accurate for small angles too.

    Examples
    --------
    >>> rotation_angle(np.diag([1.0, -1.0, -1.0]))
    180.0
    """
    r = rotation[:3, :3]
    sine = np.linalg.norm([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    return float(np.degrees(np.arctan2(sine, np.trace(r) - 1.0)))


def rigid_fit(source: Floats, target: Floats, weights: Floats | None = None) -> Floats:
    """Return the proper rigid motion (4, 4) that best moves ``source`` (n, 3) onto ``target`` (Kabsch 1976)."""
    w = np.full(len(source), 1.0) if weights is None else weights
    w = w / w.sum()
    a, b = w @ source, w @ target
    rotation = rotation_between(source - a, target - b, w)
    return homogeneous(rotation, b - rotation @ a)


def rotation_vector_matrix(vector: Floats) -> Floats:
    """Return the (3, 3) rotation by ``|vector|`` radians about ``vector`` (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * (k @ k)


def axis_rotations() -> Floats:
    """Return the 24 proper rotations that map coordinate axes to coordinate axes, identity first, (24, 3, 3)."""
    found = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[np.arange(3), order] = signs
            if np.linalg.det(matrix) > 0:
                found.append(matrix)
    return np.array(found)

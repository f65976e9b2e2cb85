"""Bring the shapes of two separate results into one correspondence: closest points of their means."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmpipe.core.align.procrustes import generalized_procrustes, rotation_between
from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import ConfigError
from ssmpipe.core.mesh.distance import point_to_mesh
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.model.shape_model import ShapeModel
from ssmpipe.core.statistics.pointwise import outward_normals, signed_distances

_JOINT = "put all scans into one config with a column that tells the groups, run it, and use compare RESULT --by COLUMN"
_ROUNDS = 10


@dataclass(frozen=True, eq=False)
class Matching:
    """Shapes of two results at the points of the first, in one frame.

    Parameters
    ----------
    points : (n_A + n_B, n_P, d) float64
        What moves along the normals of the common mean only [mm].
    rms, maximum : float
        Between the two means, from each point of the first to the surface of the second [mm].
    moved_rms : float
        How far the matched place lies from the point of the same number, root mean square [mm]: how differently the two results
        have spread their points.
    """

    points: Floats
    rms: float
    maximum: float
    moved_rms: float


def match_results(first: ShapeModel, a: Floats, second: ShapeModel, b: Floats) -> Matching:
    """Match the shapes ``b`` (n_B, n_P, d) of one result to the shapes ``a`` (n_A, n_P, d) of another.

    The mean of B is moved rigidly onto the mean of A, points of the same number first, then closest points, in turn. The places on
    B's mean that are closest to the points of A carry all shapes of B. Where a point lies along the surface was decided twice, once per
    result, and differs for reasons that are no anatomy; therefore only displacements along the normals of the common mean are kept.
    To first order they do not depend on it.

    Raises
    ------
    ConfigError
        If the results differ in topology, dimension or grid.
    """
    for what, one, other in (
        ("topology", first.topology, second.topology),
        ("dimension", first.mean.shape[1], second.mean.shape[1]),
        ("landmark grid", first.grid, second.grid),
    ):
        if one != other:
            raise ConfigError(f"the two results differ in their {what}: {_said(one)} and {_said(other)}", _JOINT)
    closed = first.topology == "curve-closed"
    if not len(first.faces) and first.mean.shape[1] == 3:
        raise ConfigError("two results of curves in space cannot be matched: they have no normal", _JOINT)
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    same = moved = _rigid(mean_b, mean_a, mean_b)
    for _ in range(_ROUNDS):
        carried = _closest(mean_a, moved, first.faces, closed)[1]
        moved = _rigid(carried(moved), mean_a, moved)
    distance, carry = _closest(mean_a, moved, first.faces, closed)
    drift = np.linalg.norm(carry(moved) - same, axis=1)
    matched = np.concatenate([a, np.stack([carry(shape) for shape in b])])
    n_points = matched.shape[1]
    found = generalized_procrustes(matched, np.full(n_points, 1.0 / n_points), remove_size=False)
    aligned = np.einsum("iab,ilb->ila", found.rotation, matched) + found.translation[:, None]
    mean = aligned.mean(axis=0)
    normals = outward_normals(mean, first.faces, closed=closed)
    points = mean + signed_distances(aligned, mean, normals)[..., None] * normals
    return Matching(
        points,
        float(np.sqrt((distance**2).mean())),
        float(distance.max()),
        float(np.sqrt((drift**2).mean())),
    )


def _said(value: object) -> str:
    return " x ".join(str(n) for n in value) if isinstance(value, tuple) else str(value)


def _rigid(source: Floats, target: Floats, points: Floats) -> Floats:
    """Return ``points`` moved by the rigid motion that best moves ``source`` onto ``target``."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    rotation = rotation_between(source - a, target - b, np.full(len(source), 1.0 / len(source)))
    return (points - a) @ rotation.T + b


class _Carrier:
    """Places on a mean, given by corners and weights, on any shape of the same points."""

    def __init__(self, corners: Ints, weights: Floats) -> None:
        self.corners, self.weights = corners, weights

    def __call__(self, points: Floats) -> Floats:
        return np.asarray(np.einsum("lk,lkd->ld", self.weights, points[self.corners]))


def _closest(query: Floats, mean: Floats, faces: Ints, closed: bool) -> tuple[Floats, _Carrier]:
    if len(faces):
        distance, face, weights = point_to_mesh(query, TriMesh(mean, faces))
        return distance, _Carrier(faces[face], weights)
    start = np.arange(len(mean) if closed else len(mean) - 1)
    ends = np.stack([start, (start + 1) % len(mean)], axis=1)
    step = mean[ends[:, 1]] - mean[ends[:, 0]]
    at = np.einsum("qsd,sd->qs", query[:, None] - mean[ends[:, 0]], step) / np.maximum((step**2).sum(axis=1), 1e-300)
    at = np.clip(at, 0.0, 1.0)
    apart = np.linalg.norm(query[:, None] - mean[ends[:, 0]] - at[..., None] * step, axis=2)
    nearest = apart.argmin(axis=1)
    along = at[np.arange(len(query)), nearest]
    return apart[np.arange(len(query)), nearest], _Carrier(ends[nearest], np.stack([1.0 - along, along], axis=1))

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from ssmpipe.core.align.procrustes import generalized_procrustes
from ssmpipe.core.align.rigid import apply, homogeneous, move, rigid_fit, rotation_vector_matrix
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.mesh.distance import point_to_mesh
from ssmpipe.core.mesh.grid import grid_faces
from ssmpipe.core.mesh.topology import compact
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.model.completion import complete
from ssmpipe.core.model.pca import principal_components
from ssmpipe.core.model.remainder import fit_remainder, leave_one_out
from ssmpipe.core.model.shape_model import ShapeModel

N_U, N_V = 30, 21


def lumps(n: int, seed: int = 0) -> np.ndarray:
    """Closed lumps without symmetry, four smooth ways to differ: (n, n_P, 3), poles repeated [mm]."""
    rng = np.random.default_rng(seed)
    u, v = np.meshgrid(2 * np.pi * np.arange(N_U) / N_U, np.linspace(-np.pi / 2, np.pi / 2, N_V), indexing="ij")
    way = np.stack([np.cos(v) * np.cos(u), np.cos(v) * np.sin(u), np.sin(v)], axis=-1)
    way[:, 0], way[:, -1] = [0, 0, -1], [0, 0, 1]
    x, y, z = np.moveaxis(way, -1, 0)
    base = 30 * (1 + 0.25 * x + 0.15 * x * y + 0.2 * z**2 - 0.2 * x * z + 0.15 * y**3)
    ways = np.stack([x**2 - y**2, x * y * z + z**3, np.exp(3 * (x - 1)), y * z])
    radius = base + 2.0 * np.einsum("sk,kuv->suv", rng.normal(size=(n, 4)), ways)
    points = radius[..., None] * way * (1 + 0.03 * rng.normal(size=(n, 1, 1, 3)))
    return points.reshape(n, -1, 3)


@cache
def setting(sizes=0.0, own=1.0):
    """A model, its remainder and a new shape in another pose; sizes vary by a share, the new shape has its own."""
    every = lumps(15) * np.r_[1 + sizes * np.random.default_rng(1).normal(size=14), own][:, None, None]
    weights = np.full(every.shape[1], 1 / every.shape[1])
    posed = generalized_procrustes(every[:-1], weights, remove_size=False)
    points = every[:-1] @ np.swapaxes(posed.rotation, 1, 2) + posed.translation[:, None]
    mean, modes, variances, scores = principal_components(points)
    faces = grid_faces(N_U, N_V, periodic_u=True, pole_start=True, pole_end=True)
    model = ShapeModel(tuple("abcdefghijklmn"), mean, modes, variances, scores, (N_U, N_V), faces, "closed")
    remainder = fit_remainder(leave_one_out(points).residuals, mean)
    turn = homogeneous(rotation_vector_matrix(np.array([0.5, -1.2, 0.8])), np.array([40.0, -10, 25]))
    return model, remainder, move(TriMesh(every[-1], faces), turn)


def fragment(whole: TriMesh, axis: int, share: float) -> tuple[TriMesh, np.ndarray]:
    """A part on one side of a plane, and which points are missing."""
    level = np.quantile(whole.vertices[:, axis], share)
    part = compact(whole, (whole.vertices[whole.faces][:, :, axis] < level).all(axis=1))
    return part, np.flatnonzero(whole.vertices[:, axis] >= level)


@pytest.mark.parametrize("axis", [0, 2])
def test_a_fragment_in_any_pose_is_completed_better_than_by_the_mean(axis):
    model, remainder, whole = setting()
    part, missing = fragment(whole, axis, 0.6)
    found = complete(part, model, remainder)
    completed = apply(np.linalg.inv(found.matrix), found.points)
    mean = apply(rigid_fit(model.mean, whole.vertices), model.mean)
    error, by_mean = (point_to_mesh(p[missing], whole)[0].mean() for p in (completed, mean))
    assert error < 0.4 * by_mean
    assert found.rms < 0.3
    truth = apply(found.matrix, whole.vertices)[missing]
    inside = np.abs(truth - found.points[missing]) < 2 * found.deviation[missing]
    assert inside.mean() > 0.85
    assert 0.3 < found.seen.mean() < 0.7
    assert not found.seen[missing].all()


def test_a_fragment_of_a_much_larger_shape_is_not_placed_askew():
    """On the mean alone its best pose was half a turn off."""
    model, remainder, whole = setting(sizes=0.08, own=1.15)
    part, missing = fragment(whole, 0, 0.6)
    found = complete(part, model, remainder)
    completed = apply(np.linalg.inv(found.matrix), found.points)
    assert np.linalg.norm(completed - whole.vertices, axis=1)[missing].mean() < 0.2


def test_what_was_seen_is_surer_than_what_was_not():
    model, remainder, whole = setting()
    part, missing = fragment(whole, 1, 0.7)
    found = complete(part, model, remainder)
    seen = np.setdiff1d(np.arange(len(model.mean)), missing)
    assert found.deviation[missing].mean() > 1.2 * found.deviation[seen].mean()
    assert found.expected_error > 0


def test_a_speck_is_not_completed_in_silence():
    model, remainder, whole = setting()
    speck = compact(whole, np.arange(6))
    with pytest.raises(GeometryError, match=r"cannot be placed|came apart"):
        complete(speck, model, remainder)

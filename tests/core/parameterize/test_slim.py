from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.mesh.primitives import flat_square, star_shape
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.parameterize.boundary import (
    corners_by_angle,
    insert_corners,
    order_corners,
    rim_of,
    split_chords,
    square_boundary,
)
from ssmpipe.core.parameterize.distortion import folded
from ssmpipe.core.parameterize.slim import parameterize_slim, symmetric_dirichlet
from ssmpipe.core.parameterize.stretch import parameterize_square
from ssmpipe.core.repair.trimming import trim


def cup() -> tuple[TriMesh, np.ndarray]:
    mesh = trim(star_shape(3), np.array([0, 0, 35.0]), np.array([0, 0, 1.0]))
    wanted = corners_by_angle(mesh, rim_of(mesh), (45, 135, 225, 315), np.eye(3)[:2])
    disk, corners, _ = insert_corners(mesh, wanted)
    disk = split_chords(disk)
    return disk, order_corners(rim_of(disk), corners)


def test_energy_of_an_affine_map():
    square = flat_square(4)
    uv = square.vertices[:, :2]
    # singular values of the map to the surface: 2 and 1/2 after the areas are made equal
    surface = TriMesh(square.vertices * [4.0, 1.0, 1.0], square.faces)
    assert symmetric_dirichlet(surface, uv) == pytest.approx(2 * (4 + 0.25))
    assert symmetric_dirichlet(surface, uv * [-1, 1]) == np.inf


def test_a_flat_square_maps_to_itself():
    rng = np.random.default_rng(0)
    square = flat_square(8, 30.0)
    inner = np.setdiff1d(np.arange(64), rim_of(square))
    vertices = square.vertices.copy()
    vertices[inner, :2] += rng.uniform(-1, 1, (len(inner), 2))
    square = split_chords(TriMesh(vertices, square.faces))
    corners = order_corners(rim_of(square), np.array([0, 56, 63, 7]))
    result = parameterize_slim(square, corners, weighting="uniform")
    assert result.value == pytest.approx(square.vertices[:, :2] / 30.0, abs=5e-3)
    assert result.history["energy"][-1] == pytest.approx(4.0, abs=1e-2)


def test_it_lowers_its_energy_and_never_folds():
    disk, corners = cup()
    result = parameterize_slim(disk, corners)
    energy = result.history["energy"]
    assert (np.diff(energy) < 0).all()
    relaxed = parameterize_square(disk, corners)
    assert energy[-1] < symmetric_dirichlet(disk, relaxed.value)
    assert not folded(result.value, disk.faces).any()
    rim, rim_uv = square_boundary(disk, corners)
    assert np.array_equal(result.value[rim], rim_uv)
    assert result.status == "converged"
    assert np.array_equal(result.value, parameterize_slim(disk, corners).value)

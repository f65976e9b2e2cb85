import numpy as np
import pytest

from ssmpipe.core.correspondence import gauss_newton
from ssmpipe.core.correspondence.reparameterization import Reparameterization


def problem(grid, boundary, n=6, seed=0):
    """Return arguments of gauss_newton_inverse with smooth tangents, and the dense matrix by its definition."""
    rng = np.random.default_rng(seed)
    space = Reparameterization((6, 5)[: len(grid)], grid, boundary=boundary)
    free = np.flatnonzero(space.free.ravel())
    where = space.evaluate(space.identity()[None])[0]
    waves = np.stack([np.sin(2 * np.pi * where @ rng.normal(size=where.shape[1]) + k) for k in range(3)])
    tangents = tuple(
        np.einsum("ik,kl,id->ild", rng.normal(size=(n, 3)), waves, rng.normal(size=(n, 3))) + rng.normal(size=3)
        for _ in grid
    )
    root = rng.normal(size=(n, n))
    coupling = root @ root.T + 0.1 * np.eye(n)
    own = np.stack([a @ a.T for a in 0.2 * rng.normal(size=(n, len(free), len(free)))])
    weights = np.full(len(where), 1.0 / len(where))
    rows = space.rows_at(where)
    n_d = len(grid)
    moves = np.stack(
        [
            np.stack([rows[:, k // n_d, None] * tangents[k % n_d][i] for k in free], axis=-1).reshape(-1, len(free))
            for i in range(n)
        ]
    )
    scaled = moves * np.repeat(np.sqrt(weights), 3)[:, None]
    whole = np.einsum("ij,ilk,jlm->ikjm", coupling, scaled, scaled)
    for i in range(n):
        whole[i, :, i] += own[i]
    size = n * len(free)
    return (space, coupling, weights, tangents, own), whole.reshape(size, size)


@pytest.mark.parametrize(("grid", "boundary"), [((13, 11), "fixed"), ((13, 11), "periodic"), ((40,), "fixed")])
def test_the_factor_inverts_the_matrix_of_the_definition(grid, boundary):
    arguments, dense = problem(grid, boundary)
    vector = np.random.default_rng(3).normal(size=len(dense))
    got = gauss_newton.gauss_newton_inverse(*arguments)(dense @ vector)
    np.testing.assert_allclose(got, vector, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("grid", "boundary"), [((13, 11), "fixed"), ((41, 41), "periodic"), ((40,), "fixed")])
def test_the_iteration_solves_nearly_the_same_system(grid, boundary, monkeypatch):
    arguments, dense = problem(grid, boundary)
    monkeypatch.setattr(gauss_newton, "FACTORED_UNKNOWNS", 0)
    monkeypatch.setattr(gauss_newton, "_RESIDUAL", 1e-3)
    monkeypatch.setattr(gauss_newton, "_MOST_PRODUCTS", 500)
    vector = np.random.default_rng(3).normal(size=len(dense))
    apply = gauss_newton.gauss_newton_inverse(*arguments)
    exact = np.linalg.solve(dense, vector)
    error = apply(vector) - exact
    # every k-th landmark stands for all of them: a few percent
    assert error @ dense @ error < 0.1**2 * exact @ dense @ exact
    assert apply(np.zeros_like(vector)) @ vector == 0

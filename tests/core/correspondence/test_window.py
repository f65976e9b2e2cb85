from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.correspondence.certificate import certify, injective_edges
from ssmpipe.core.correspondence.inequalities import Inequalities
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.correspondence.window import Bounds, Window
from ssmpipe.core.errors import GeometryError

INNER = Window((0.1, 0.15), (0.85, 0.9))
BELT = Window((0.0, 0.1), (1.0, 0.8))
BOTH = [(INNER, "fixed"), (BELT, "periodic")]


def moved(space: Reparameterization, size: float, seed: int = 0, n: int = 3) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(n, *space.n_coefficients, 2))
    return space.identity() + size * noise * space.free


@pytest.mark.parametrize(("low", "high"), [((0.0, 0.5), (1.0, 0.5)), ((-0.1, 0.0), (1.0, 1.0)), ((0, 0), (1.0, 1.2))])
def test_what_is_no_part_of_the_square_is_refused(low, high) -> None:
    with pytest.raises(GeometryError, match="no part of the unit square"):
        Window(low, high)


@pytest.mark.parametrize(("window", "boundary"), BOTH)
def test_the_identity_covers_the_window(window, boundary) -> None:
    space = Reparameterization((6, 5), (9, 8), boundary=boundary, window=window)
    at = space.evaluate(space.identity()[None])[0]
    grid = np.stack(np.meshgrid(*space.nodes, indexing="ij"), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(at, window.image(grid), atol=1e-14)
    slopes = space.slopes(space.identity()[None])
    for axis, slope in enumerate(slopes):
        np.testing.assert_allclose(slope[0], np.tile(window.extent * np.eye(2)[axis], (len(at), 1)), atol=1e-13)


@pytest.mark.parametrize(("window", "boundary"), BOTH)
def test_open_edges_are_free_and_others_as_before(window, boundary) -> None:
    opened = Reparameterization((6, 5), (3, 3), boundary=boundary, window=window).free
    before = Reparameterization((6, 5), (3, 3), boundary=boundary).free
    edges = np.zeros_like(before)
    for axis, end in window.open_edges:
        edges[(slice(None),) * axis + (end,)] = True
    np.testing.assert_array_equal(opened, before | edges)


@pytest.mark.parametrize(("window", "boundary"), BOTH)
def test_positive_slacks_keep_edges_inside(window, boundary) -> None:
    space = Reparameterization((6, 5), (201, 201), boundary=boundary, window=window)
    bounds = Bounds(space.n_coefficients, window)
    for seed in range(20):
        b = moved(space, 0.06, seed, n=1)
        b_inside = b.copy()
        for axis, end in window.open_edges:
            edge = (0, *(slice(None),) * axis, end)
            b_inside[edge][..., axis] = np.clip(b[edge][..., axis], 1e-9, 1 - 1e-9)
        assert bounds.slack(b_inside).min() > 0
        displaced = space.displacements(b_inside - space.identity())[0]
        field = window.image(np.stack(np.meshgrid(*space.nodes, indexing="ij"), axis=-1)) + displaced.T.reshape(
            *space.grid, 2
        )
        for axis, end in window.open_edges:
            at = np.take(field[..., axis], end, axis=axis)
            assert at.min() > 0
            assert at.max() < 1


@pytest.mark.parametrize(("window", "boundary"), BOTH)
def test_derivatives_of_the_inequalities(window, boundary) -> None:
    space = Reparameterization((6, 5), (3, 3), boundary=boundary, window=window)
    both = Inequalities(space, "bezier")
    rng = np.random.default_rng(1)
    b, d = moved(space, 0.01), rng.normal(size=(3, 6, 5, 2)) * space.free
    local = both.at(b)
    first, second = local.along(d)
    np.testing.assert_allclose(both.coefficients(b + 0.3 * d), local.values + 0.3 * first + 0.09 * second, atol=1e-12)
    weights = rng.normal(size=local.values.shape)
    assert (local.pull_back(weights) * d).sum() == pytest.approx((weights * first).sum(), rel=1e-12)
    # of the blocks: d' B d is the weighted sum of squared changes
    curvature = rng.uniform(1, 2, size=local.values.shape)
    for block, one, change, k in zip(both.normal_blocks(b, curvature), d, first, curvature, strict=True):
        flat = one[space.free]
        assert flat @ block @ flat == pytest.approx((k * change**2).sum(), rel=1e-10)
    ahead = both.at(b + 1e-6 * d).pull_back(weights + 1e-6 * 2.0 * first)
    behind = both.at(b - 1e-6 * d).pull_back(weights - 1e-6 * 2.0 * first)
    along = local.pull_back_along(d, lambda change: 2.0 * change, weights)
    np.testing.assert_allclose(along, (ahead - behind) / 2e-6, atol=1e-6 * np.abs(along).max())


@pytest.mark.parametrize(("window", "boundary"), BOTH)
def test_what_is_proved_is_one_to_one(window, boundary) -> None:
    space = Reparameterization((6, 6), (41, 41), boundary=boundary, window=window)
    n_proved = 0
    for seed in range(30):
        b = moved(space, 0.015 * (1 + seed % 4), seed, n=1)[0]
        if certify(b, space).verdict != "proved":
            continue
        n_proved += 1
        field = space.evaluate(b[None])[0].reshape(*space.grid, 2)
        # no two places of a grid meet, and it stays inside
        flat = field.reshape(-1, 2)
        if boundary == "periodic":
            angle = 2 * np.pi * flat[:, 0]
            flat = np.stack([np.cos(angle), np.sin(angle), 3 * flat[:, 1]], axis=1)
        distance = np.linalg.norm(flat[:, None] - flat[None], axis=-1) + np.eye(len(flat))
        assert distance.min() > 1e-4
        assert field[..., 1].min() > 0
        assert field[..., 1].max() < 1
    assert n_proved > 5


def test_overlaps_are_not_proved() -> None:
    # a square bent around until its ends overlap: positive Jacobian everywhere, not one-to-one
    space = Reparameterization((10, 10), (41, 41), window=Window((0.05, 0.05), (0.95, 0.95)))
    t = space.identity()
    angle, radius = 2 * np.pi * 1.15 * (1 - t[..., 0]), 0.15 + 0.25 * t[..., 1]
    b = 0.5 + np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    local = Inequalities(space, "bezier").at(b[None])
    assert local.values.min() > 0  # what the optimization sees is fine
    assert not injective_edges(b, space)
    assert certify(b, space).verdict == "undecided"


def test_a_rim_outside_of_the_domain_is_not_proved() -> None:
    space = Reparameterization((6, 6), (5, 5), boundary="periodic", window=BELT)
    b = space.identity()
    assert certify(b, space).verdict == "proved"
    b[2, -1, 1] = 1.01
    assert certify(b, space).verdict == "undecided"


def test_rims_that_run_back_are_not_proved() -> None:
    space = Reparameterization((8, 6), (5, 5), boundary="periodic", window=BELT)
    b = space.identity()
    b[3, -1, 0], b[4, -1, 0] = b[4, -1, 0], b[3, -1, 0]
    assert not injective_edges(b, space)

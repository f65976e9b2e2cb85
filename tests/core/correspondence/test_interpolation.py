from dataclasses import replace

import numpy as np
import pytest

from ssmpipe.core.correspondence.guides import Guides
from ssmpipe.core.correspondence.interpolation import Interpolation
from ssmpipe.core.correspondence.objective import GroupObjective
from ssmpipe.core.correspondence.optimize import optimize_correspondence
from ssmpipe.core.correspondence.options import EngineOptions
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.correspondence.spectral import spectral_function
from ssmpipe.core.errors import FoldoverError, LandmarkError
from ssmpipe.core.spline.evaluate import SplineStack
from tests.core.correspondence.test_options import closed_curve
from tests.support.surfaces import bump, taylor_rate

CENTRES = np.array([(24.0, 30.0), (30.0, 33.0), (36.0, 27.0), (27.0, 26.0)])
SHAPES = [bump(tuple(c), 20.0) for c in CENTRES]
BASE = EngineOptions(
    n_coefficients=(7, 7), landmarks=(25, 25), normalize="none", pose="keep", lambda_cut=1e-3, guide_mode="interpolate"
)
OFF = np.array([3.0, -2.0])


def marks(*, missing: bool = False):
    """Top of the bump, and a place on its side that is not the same on all: a guide that the shapes alone would not choose."""

    def on(k, offset):
        c, at = CENTRES[k], CENTRES[k] + offset
        return np.array([*at, 20.0 * np.exp(-((at - c) ** 2).sum() / 128.0)])

    all_of_them = [{"top": on(k, 0 * OFF), "side": on(k, OFF * (1 + 0.4 * k))} for k in range(4)]
    if missing:
        del all_of_them[2]["side"]
    return all_of_them


def small(reference=1, seed=0):
    """An objective with three guides, one of them missing on the last shape, and unknowns that meet them."""
    space = Reparameterization((7, 6), (21, 23))
    rng = np.random.default_rng(seed)
    common = np.array([[0.3, 0.4], [0.6, 0.35], [0.55, 0.7]])
    own = common + 0.01 * rng.normal(size=(4, 3, 2))
    own[1] = common
    present = np.ones((4, 3), dtype=bool)
    present[3, 1] = reference < 0
    tangents = 60.0 * np.eye(2, 3)[None, None] + rng.normal(size=(4, 3, 2, 3))
    if reference < 0:
        own -= own.mean(axis=0) - common
    guides = Guides(space, common, own, tangents, present, 1e4)
    f = GroupObjective(
        SplineStack(SHAPES),
        space,
        spectral_function("description-length", 1e-3),
        reference=reference,
        guides=guides,
        interpolate=True,
        prior=0.1,
        barrier=0.5,
    )
    start = Interpolation(guides, space.free, f.moving).meet(f.coefficients(f.start()))
    return f, guides, f.unknowns(start)


def missed(guides, coefficients):
    return np.abs(guides.residual(coefficients)[guides.present]).max()


@pytest.mark.parametrize("reference", [1, -1])
def test_the_nearest_maps_meet_the_guides_and_projected_steps_keep_them(reference):
    f, guides, x = small(reference)
    assert missed(guides, f.coefficients(f.start())) > 1e-3
    assert missed(guides, f.coefficients(x)) < 1e-14
    rng = np.random.default_rng(1)
    a, b = (f._keep_gauge(rng.normal(size=x.size)) for _ in range(2))
    assert missed(guides, f.coefficients(x + 0.01 * a)) < 1e-13
    np.testing.assert_allclose(f._keep_gauge(a), a, atol=1e-13)
    raw = rng.normal(size=x.size)
    assert raw @ f._keep_gauge(b) == pytest.approx(f._keep_gauge(raw) @ b, rel=1e-10)
    if reference < 0:
        assert np.abs(a.reshape(len(f.moving), -1).mean(axis=0)).max() < 1e-13


@pytest.mark.parametrize("reference", [1, -1])
def test_gradient_on_the_plane_is_exact(reference):
    f, _, x = small(reference)
    direction = f._keep_gauge(np.random.default_rng(2).normal(size=x.size))
    direction /= 10 * np.linalg.norm(direction)
    assert taylor_rate(lambda y: f.value_and_gradient(y)[0], f.value_and_gradient(x)[1], x, direction) > 1.8


def test_preconditioner_is_that_of_the_eliminated_problem():
    f, guides, x = small()
    free = f._free.ravel()
    rows = np.kron(guides.rows, np.eye(2))[:, free]
    blocks = [rows[np.repeat(guides.present[i], 2)] for i in f.moving]
    n = int(free.sum())
    conditions = np.zeros((sum(map(len, blocks)), x.size))
    at = 0
    for k, block in enumerate(blocks):
        conditions[at : at + len(block), k * n : (k + 1) * n] = block
        at += len(block)
    kernel = np.linalg.svd(conditions)[2][len(conditions) :].T
    plain = GroupObjective(
        f.stack, f.reparameterization, f.spectral, reference=1, prior=f.prior, barrier=f.barrier
    ).preconditioner(x)
    inverse = np.stack([plain(e) for e in np.eye(x.size)])
    eliminated = kernel @ np.linalg.solve(kernel.T @ np.linalg.inv(inverse) @ kernel, kernel.T)
    gradient = f.value_and_gradient(x)[1]
    step = f.preconditioner(x)(gradient)
    expected = eliminated @ gradient
    assert np.linalg.norm(step - expected) < 0.02 * np.linalg.norm(expected)
    assert np.abs(conditions @ step).max() < 1e-14


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"boundary": "sliding"},
        {"boundary": "periodic", "barriers": (30.0,)},
        {"reference": "none"},
        {"solver": "newton"},
        {"covariance": "II"},
        {"coarse_to_fine": True, "n_coefficients": (10, 10)},
        {"aggregate": "ks", "sharpness": 200.0},
        {"pose": "refined", "normalize": "affine"},
    ],
    ids=str,
)
def test_guides_are_met_to_rounding_and_the_maps_are_proved(changes):
    result = optimize_correspondence(SHAPES, replace(BASE, **changes), guides=marks())
    assert np.nanmax(result.value.guide_residuals) < 1e-9
    assert all(c.verdict == "proved" for c in result.value.certificates)
    assert result.history["max_constraint"].max() < 0


def test_no_weight_of_the_penalty_does_better_at_the_same_miss():
    hard = optimize_correspondence(SHAPES, BASE, guides=marks()).value
    soft = optimize_correspondence(SHAPES, replace(BASE, guide_mode="penalty", guide_weight=1e4), guides=marks()).value
    assert np.nanmax(hard.guide_residuals) < 1e-9 < 1e-6 < np.nanmax(soft.guide_residuals)
    assert hard.description_length[1] < soft.description_length[1] + 0.05


def test_guides_far_apart_are_reached_through_feasible_maps():
    """The nearest maps that meet these guides fold; the pull finds some that do not."""
    far = [{"a": np.array([30.0 + s, 30.0, 0.0]), "b": np.array([34.0 + s, 30.0, 0.0])} for s in (-14.0, 0.0, 12.0)]
    shapes = [bump((12.0, 12.0), 0.01) for _ in far]
    options = replace(BASE, n_coefficients=(9, 9), reference=1, objective="trace", lambda_cut=100.0)
    optimum = optimize_correspondence(shapes, options, guides=far).value
    assert np.nanmax(optimum.guide_residuals) < 1e-9
    assert all(c.verdict == "proved" for c in optimum.certificates)


def test_a_missing_guide_binds_only_the_others():
    optimum = optimize_correspondence(SHAPES, replace(BASE, reference=1), guides=marks(missing=True)).value
    # names in order: side, top
    assert np.isnan(optimum.guide_residuals[2]).tolist() == [True, False]
    assert np.nanmax(optimum.guide_residuals) < 1e-9
    with pytest.raises(LandmarkError, match="shape number 3 lacks one"):
        optimize_correspondence(SHAPES, replace(BASE, reference="none"), guides=marks(missing=True))


def test_a_guide_that_no_map_can_carry_is_refused_unless_the_miss_is_allowed():
    edge = [{"edge": np.array([30.0 + 0.05 * k, 0.0, 0.0])} for k in range(4)]
    flat = [bump((30.0, 30.0), 10.0 + k) for k in range(4)]
    options = replace(BASE, reference=0, barriers=(30.0,))
    with pytest.raises(FoldoverError, match=r"0\.15 mm are left, 0\.01 mm are allowed"):
        optimize_correspondence(flat, options, guides=edge)
    allowed = optimize_correspondence(flat, replace(options, guide_tolerance=0.2), guides=edge).value
    assert np.nanmax(allowed.guide_residuals) == pytest.approx(0.15, abs=1e-6)
    slid = optimize_correspondence(flat, replace(options, boundary="sliding"), guides=edge).value
    assert np.nanmax(slid.guide_residuals) < 1e-9


def test_closed_curves_meet_a_guide_across_the_seam():
    curves = [closed_curve(shift, phase) for shift, phase in ((0.5, 0.45), (0.6, 0.65), (0.4, 0.3))]
    tips = []
    for shift in (0.5, 0.6, 0.4):
        tips.append({"tip": 13.0 * np.array([1.5 * np.cos(shift), np.sin(shift)])})
    options = EngineOptions(
        n_coefficients=(12,), landmarks=(60,), boundary="periodic", guide_mode="interpolate", normalize="none"
    )
    optimum = optimize_correspondence(curves, options, guides=tips).value
    assert np.nanmax(optimum.guide_residuals) < 1e-9
    assert all(c.verdict == "proved" for c in optimum.certificates)

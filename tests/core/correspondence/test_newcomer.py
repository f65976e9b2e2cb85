from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ssmpipe.core.align.rigid import homogeneous, rotation_vector_matrix
from ssmpipe.core.correspondence import newcomer
from ssmpipe.core.correspondence.affine_start import LEAST_JACOBIAN, turned_identity
from ssmpipe.core.correspondence.covariance import centred_spectrum
from ssmpipe.core.correspondence.inequalities import Inequalities
from ssmpipe.core.correspondence.newcomer import FixedCohort, NewcomerObjective, bring_in
from ssmpipe.core.correspondence.optimize import optimize_correspondence
from ssmpipe.core.correspondence.options import EngineOptions
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.evaluate import SplineStack
from ssmpipe.core.spline.surface import BSplineSurface
from tests.support.cohorts import line_bumps
from tests.support.surfaces import bumps, taylor_rate, wrapped

OPTIONS = EngineOptions(n_coefficients=(6, 6), landmarks=(17, 17), barriers=(3.0,), max_iterations=60)


@cache
def finished(normals=0.0):
    splines = bumps(6)
    return splines, optimize_correspondence(splines, replace(OPTIONS, normals=normals)).value


def cohort(**changes):
    _, optimum = finished(changes.get("normals", 0.0))
    options = replace(OPTIONS, lambda_cut=optimum.lambda_cut, **changes)
    seen = {"normals": optimum.normals, "normal_scale": optimum.normal_scale}
    return FixedCohort(optimum.points, (17, 17), closes=False, options=options, **seen)


@pytest.mark.parametrize("covariance", ["discrete", "I", "II"])
@pytest.mark.parametrize("boundary", ["fixed", "sliding", "periodic"])
def test_the_gradient_is_exact(covariance, boundary):
    fixed = cohort(covariance=covariance, boundary=boundary, normalize="none")
    f = NewcomerObjective(
        bumps(1, seed=9)[0], fixed.space, fixed.fixed, fixed.weights, lambda_of(fixed), prior=0.3, barrier=0.7
    )
    rng = np.random.default_rng(0)
    x = f.unknowns(fixed.space.identity()) + 0.01 * rng.normal(size=f.unknowns(fixed.space.identity()).size)
    direction = rng.normal(size=x.size)
    direction /= 10 * np.linalg.norm(direction)
    assert taylor_rate(lambda y: f.value_and_gradient(y)[0], f.value_and_gradient(x)[1], x, direction) > 1.8


def lambda_of(fixed):
    from ssmpipe.core.correspondence.spectral import spectral_function

    return spectral_function("description-length", float(fixed.options.lambda_cut))


def rms(offsets):
    return float(np.sqrt((offsets**2).sum(axis=-1).mean()))


@pytest.mark.parametrize("normals", [0.0, 0.8])
def test_a_shape_of_the_cohort_comes_back_nearly_as_it_was(normals):
    splines, optimum = finished(normals)
    fixed = cohort(normals=normals)
    for k, spline in enumerate(splines):
        found = bring_in(spline, fixed).value
        assert found.certificate.verdict == "proved"
        start, end = rms(found.initial_points - optimum.points[k]), rms(found.points - optimum.points[k])
        if k == optimum.reference:
            assert end < 0.1
        else:
            assert end < 0.25 * start, (k, start, end)


def test_the_fixed_shapes_are_seen_as_the_group_saw_them():
    _, optimum = finished(0.8)
    seen = cohort(normals=0.8).seen
    centred, spectrum = centred_spectrum(seen, np.full(seen.shape[1], 1 / seen.shape[1]))
    assert centred.shape[2] == 6
    np.testing.assert_allclose(spectrum.eigenvalues, optimum.eigenvalues, rtol=0.02, atol=optimum.lambda_cut)


@pytest.mark.parametrize("normalize", ["none", "size", "affine"])
def test_fixed_curves_are_seen_with_their_tangents_as_the_group_saw_them(normalize):
    splines = line_bumps(6, n_control=20, tilt=0.3)
    options = EngineOptions(n_coefficients=(8,), landmarks=(41,), normals=0.5, normalize=normalize, barriers=(3.0,))
    optimum = optimize_correspondence(splines, options).value
    options = replace(options, lambda_cut=optimum.lambda_cut)
    seen = {"normals": optimum.normals, "normal_scale": optimum.normal_scale}
    fixed = FixedCohort(optimum.points, (41,), closes=False, options=options, **seen)
    centred, spectrum = centred_spectrum(fixed.seen, fixed.weights)
    assert centred.shape[2] == 4
    np.testing.assert_allclose(spectrum.eigenvalues[0], optimum.eigenvalues[0], rtol=0.01)
    for k in range(1, 5):
        found = bring_in(splines[k], fixed).value
        start, end = rms(found.initial_points - optimum.points[k]), rms(found.points - optimum.points[k])
        assert end < max(0.1 * start, 0.02), k


def test_a_new_shape_is_put_into_correspondence():
    fixed, stranger = cohort(), bumps(1, seed=9)[0]
    found = bring_in(stranger, fixed).value
    before, after = found.description_length
    assert after < before - 0.5
    peak = found.initial_points[:, 2].argmax(), found.points[:, 2].argmax()
    where = fixed.points[:, :, 2].argmax(axis=1)
    grid = lambda k: np.array(np.unravel_index(k, (17, 17)), dtype=float)  # noqa: E731
    usual = np.mean([grid(k) for k in where], axis=0)
    assert np.linalg.norm(grid(peak[1]) - usual) < np.linalg.norm(grid(peak[0]) - usual)
    on_it = SplineStack([stranger]).evaluate(found.parameters[None]).points[0]
    moved = on_it @ found.matrix[:3, :3].T + found.matrix[:3, 3]
    np.testing.assert_allclose(moved, found.points, atol=1e-12)


def test_the_pose_given_does_not_matter():
    fixed, stranger = cohort(), bumps(1, seed=9)[0]
    turn = homogeneous(rotation_vector_matrix(np.array([0.02, -0.03, 0.05])), np.array([1.0, -2.0, 0.5]))
    moved = BSplineSurface(
        stranger.degree, stranger.knots_u, stranger.knots_v, stranger.control_points @ turn[:3, :3].T + turn[:3, 3]
    )
    a, b = bring_in(stranger, fixed).value, bring_in(moved, fixed).value
    assert rms(a.points - b.points) < 0.05
    np.testing.assert_allclose(b.matrix @ turn, a.matrix, atol=0.1)


def test_the_same_input_gives_the_same_bits():
    a, b = (bring_in(bumps(1, seed=9)[0], cohort()).value for _ in range(2))
    assert np.array_equal(a.points, b.points)


def test_what_cannot_join_is_refused():
    with pytest.raises(GeometryError, match="1 parameters in 2 dimensions cannot join"):
        bring_in(line_bumps(1)[0], cohort())
    _, optimum = finished()
    with pytest.raises(GeometryError, match="threshold"):
        FixedCohort(optimum.points, (17, 17), closes=False, options=OPTIONS)
    with pytest.raises(GeometryError, match="of 1 shape cannot take"):
        FixedCohort(optimum.points[:1], (17, 17), closes=False, options=OPTIONS)


def test_an_affine_start_begins_near_the_end_and_ends_no_worse():
    stranger = bumps(1, seed=9)[0]
    plain = bring_in(stranger, cohort()).value
    result = bring_in(stranger, cohort(start="affine"))
    assert result.value.certificate.verdict == "proved"
    assert result.value.description_length[0] == pytest.approx(plain.description_length[0], rel=0.02)
    assert result.value.description_length[1] < plain.description_length[1] + 0.2
    splines, optimum = finished()
    back = bring_in(splines[1], cohort(start="affine")).value
    assert rms(back.points - optimum.points[1]) < 0.25 * rms(back.initial_points - optimum.points[1])


def test_an_affine_start_that_folds_is_taken_back_on_its_way(monkeypatch):
    fixed = cohort(start="affine")
    turned = turned_identity(fixed.space, np.zeros(1))[0]
    way = 0.4 * np.random.default_rng(0).normal(size=turned.shape) * fixed.space.free
    monkeypatch.setattr(newcomer, "affine_start_onto", lambda *_, **__: (turned + way)[None])
    found = newcomer._affine_start(SplineStack([bumps(1, seed=9)[0]]), fixed, turned, 0.0)
    share = float(np.linalg.norm(found - turned) / np.linalg.norm(way))
    np.testing.assert_allclose(found, turned + share * way, atol=1e-12)
    steps = np.log(share) / np.log(0.85)
    assert steps == pytest.approx(round(steps), abs=1e-6)
    assert 1 <= round(steps) < 29
    walls = Inequalities(fixed.space, fixed.options.form)
    near, far = (walls.coefficients((turned + s * way)[None]).min() for s in (share, share / 0.85))
    assert near > LEAST_JACOBIAN > far


@pytest.mark.parametrize("start", ["identity", "affine"])
def test_a_shape_whose_parameter_lines_start_elsewhere_is_turned(start):
    options = EngineOptions(
        n_coefficients=(6, 6), landmarks=(20, 15), boundary="periodic", pose="keep", reference=0, start=start
    )
    optimum = optimize_correspondence([wrapped("tube", n=16, bump=b) for b in (1.0, 0.7, 1.2, 1.4)], options).value
    options = replace(options, lambda_cut=optimum.lambda_cut)
    fixed = FixedCohort(optimum.points, (20, 15), closes=True, options=options)
    found = bring_in(wrapped("tube", n=16, phase=0.35, bump=1.1), fixed).value
    field = found.parameters.reshape(20, 15, 2)
    turn = (field[..., 0] - (np.arange(20) / 20)[:, None])[:, 3:-3].mean()
    assert (turn + 0.35 + 0.5) % 1.0 - 0.5 == pytest.approx(0.0, abs=2e-3)
    assert found.certificate.verdict == "proved"

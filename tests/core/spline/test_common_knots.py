"""Laws of the union of knots: the curves stay, ends and seams to the bit; what cannot share knots is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.common_knots import insertion_matrix, on_common_knots
from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.evaluate import SplineStack
from ssmpipe.core.spline.fit_curve import clamp_periodic, curve_points
from ssmpipe.core.spline.knots import clamped_uniform_knots
from ssmpipe.core.spline.surface import BSplineSurface

U = np.linspace(0, 1, 401)


def curve(n_control: int, degree: int, seed: int = 0) -> BSplineCurve:
    control = np.random.default_rng(seed).normal(size=(n_control, 2))
    return BSplineCurve(degree, clamped_uniform_knots(n_control, degree), control)


@given(st.integers(1, 5), st.lists(st.integers(6, 70), min_size=2, max_size=5), st.integers(0, 99))
def test_curves_stay_what_they_are(degree, numbers, seed):
    curves = [curve(n, degree, seed + n) for n in numbers]
    common = on_common_knots(curves)
    SplineStack(common)
    for given_, made in zip(curves, common, strict=True):
        np.testing.assert_allclose(curve_points(made, U), curve_points(given_, U), rtol=0, atol=1e-12)
        np.testing.assert_array_equal(made.control_points[[0, -1]], given_.control_points[[0, -1]])


def test_knots_that_agree_are_left_alone():
    curves = [curve(9, 2, seed) for seed in range(3)]
    assert on_common_knots(curves) is curves


def test_a_knot_that_two_have_is_taken_once_and_a_double_one_twice():
    fine = on_common_knots([curve(3 + 2, 2), curve(6 + 2, 2)])[0].knots
    np.testing.assert_allclose(fine, clamped_uniform_knots(8, 2), rtol=0, atol=1e-15)
    kink = BSplineCurve(2, np.array([0, 0, 0, 1 / 3, 1 / 3, 1, 1, 1]), np.eye(5))
    fine = on_common_knots([kink, BSplineCurve(2, clamped_uniform_knots(5, 2), np.eye(5))])[1].knots
    np.testing.assert_allclose(fine, [0, 0, 0, 1 / 3, 1 / 3, 2 / 3, 1, 1, 1])
    # rounding: one knot, two numbers
    ways = [np.arange(1, 49) / 49, np.cumsum(np.full(48, 1 / 49))]
    assert not np.array_equal(*ways)
    both = [BSplineCurve(1, np.concatenate([[0, 0], w, [1, 1]]), np.zeros((50, 1))) for w in ways]
    assert len(on_common_knots(both)[0].control_points) == 50


def test_closed_curves_stay_closed_to_the_bit():
    rng = np.random.default_rng(1)
    for made in on_common_knots([clamp_periodic(rng.normal(size=(n, 2)), 3) for n in (17, 23, 40)]):
        np.testing.assert_array_equal(made.control_points[0], made.control_points[-1])


@pytest.mark.parametrize("degree", [1, 2, 3, 5])
def test_the_matrix_agrees_with_single_knots_inserted_by_another_hand(degree):
    coarse = clamped_uniform_knots(9, degree)
    spline = BSpline(coarse, np.eye(9), degree)
    for x in (0.03, 0.5, 0.5, 0.77) if degree > 1 else (0.03, 0.77):
        spline = spline.insert_knot(x)
    matrix = insertion_matrix(coarse, spline.t, degree)
    np.testing.assert_allclose(matrix, spline.c, atol=1e-14)
    np.testing.assert_allclose(matrix.sum(axis=1), 1.0, atol=1e-14)
    assert matrix.min() > -1e-15


def test_surfaces_stay_what_they_are():
    rng = np.random.default_rng(2)
    surfaces = [
        BSplineSurface((2, 3), clamped_uniform_knots(n, 2), clamped_uniform_knots(m, 3), rng.normal(size=(n, m, 3)))
        for n, m in ((7, 9), (8, 9), (12, 6))
    ]
    common = on_common_knots(surfaces)
    at = rng.uniform(size=(1, 300, 2))
    SplineStack(common)
    for given_, made in zip(surfaces, common, strict=True):
        points = [SplineStack([s]).evaluate(at).points for s in (given_, made)]
        np.testing.assert_allclose(points[1], points[0], atol=1e-12)


def test_other_degrees_and_dimensions_are_refused():
    with pytest.raises(GeometryError, match=r"spline 1 has degrees \(3,\)"):
        on_common_knots([curve(9, 2), curve(9, 3)])
    with pytest.raises(GeometryError, match="dimension 1"):
        on_common_knots([curve(9, 2), BSplineCurve(2, clamped_uniform_knots(9, 2), np.zeros((9, 1)))])

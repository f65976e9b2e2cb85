"""Laws of the curve fit: order, closure, exact reproduction, refusal."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssmpipe.core.errors import ConvergenceError, GeometryError
from ssmpipe.core.outline.distance import point_to_segments
from ssmpipe.core.outline.outline import edge_indices
from ssmpipe.core.spline.arc_length import arc_length_at
from ssmpipe.core.spline.basis import design_matrix, periodic_design_matrix
from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.fit_curve import (
    clamp_periodic,
    curve_points,
    data_parameters,
    fewest_control_points,
    fit_curve,
)
from ssmpipe.core.spline.knots import clamped_uniform_knots


def wave(n: int, closed: bool) -> tuple[np.ndarray, np.ndarray]:
    u = np.arange(n) / n if closed else np.linspace(0, 1, n)
    a = 2 * np.pi * u
    r = 1 + 0.3 * np.cos(3 * a + 0.5)
    return u, np.column_stack([r * np.cos(a), r * np.sin(a)])


def largest_distance(curve: BSplineCurve, points: np.ndarray) -> float:
    dense = curve_points(curve, np.linspace(0, 1, 32 * max(len(curve.control_points), len(points)) + 1))
    return float(point_to_segments(points, dense, edge_indices(len(dense), False))[0].max())


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("degree", [1, 2, 3, 5])
def test_error_falls_with_the_order_of_the_degree(degree, closed):
    u, points = wave(2000, closed)
    errors = []
    for n_spans in (16, 32, 64):
        curve = fit_curve(points, degree=degree, n_control=n_spans + degree, closed=closed, parameters=u)
        errors.append(np.sqrt(((curve_points(curve, u) - points) ** 2).sum(axis=1).mean()))
    rates = -np.diff(np.log2(errors))
    assert rates.min() > degree + 0.75
    assert rates[-1] < degree + 1.5


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_a_spline_of_the_space_is_reproduced(degree):
    rng = np.random.default_rng(degree)
    knots = clamped_uniform_knots(12, degree)
    u = np.sort(np.concatenate([[0, 1], rng.uniform(0, 1, 80)]))
    control = rng.normal(size=(12, 2))
    curve = fit_curve(design_matrix(u, knots, degree) @ control, degree=degree, n_control=12, parameters=u)
    np.testing.assert_allclose(curve.control_points, control, atol=1e-9)
    ring = clamp_periodic(rng.normal(size=(11, 2)), degree)
    u = np.sort(np.concatenate([[0.0], rng.uniform(0, 1, 80)]))
    again = fit_curve(curve_points(ring, u), degree=degree, n_control=11 + degree, closed=True, parameters=u)
    np.testing.assert_allclose(again.control_points, ring.control_points, atol=1e-9)


@pytest.mark.parametrize("degree", [2, 3, 4])
def test_closed_curves_close_to_machine_precision_with_their_derivatives(degree):
    rng = np.random.default_rng(0)
    coefficients = rng.normal(size=(10, 2))
    curve = clamp_periodic(coefficients, degree)
    assert np.array_equal(curve.control_points[0], curve.control_points[-1])
    u = np.linspace(0, 1, 301)
    periodic = periodic_design_matrix(u, 10, degree) @ coefficients
    np.testing.assert_allclose(curve_points(curve, u), periodic, atol=5e-15)
    ends = np.array([0.0, 1.0])
    for order in range(1, degree):
        start, end = design_matrix(ends, curve.knots, degree, order) @ curve.control_points
        np.testing.assert_allclose(start, end, rtol=1e-10, atol=1e-10)


def test_open_curves_meet_their_ends_and_closed_ones_do_not_depend_on_the_first_point_much():
    _, points = wave(50, False)
    curve = fit_curve(points + [3, 4], n_control=12)
    np.testing.assert_array_equal(curve.control_points[[0, -1]], points[[0, -1]] + [3, 4])
    _, ring = wave(400, True)
    a = fit_curve(ring, n_control=42, closed=True)
    b = fit_curve(np.roll(ring, -130, axis=0), n_control=42, closed=True)
    assert largest_distance(a, curve_points(b, np.linspace(0, 1, 500))) < 1e-3


def test_arc_length_parameters_give_constant_speed_whatever_the_spacing():
    rng = np.random.default_rng(3)
    a = np.sort(rng.uniform(0, 2 * np.pi, 400))
    ellipse = np.column_stack([3 * np.cos(a), np.sin(a)])
    u = np.linspace(0, 1, 200)
    speeds = {}
    for spacing in ("arc-length", "chord", "centripetal", "uniform"):
        curve = fit_curve(ellipse, n_control=40, closed=True, parameters=spacing, fairness=1e-13)
        speed = np.linalg.norm(design_matrix(u, curve.knots, 2, 1) @ curve.control_points, axis=1)
        speeds[spacing] = speed.std() / speed.mean()
    assert speeds["arc-length"] < 0.02 < speeds["centripetal"] < speeds["uniform"]
    assert speeds["arc-length"] <= speeds["chord"] * 1.05


def test_data_parameters():
    square = np.array([[0, 0], [4, 0], [4, 1], [0, 1.0]])
    np.testing.assert_allclose(data_parameters(square, "chord", closed=True), [0, 0.4, 0.5, 0.9])
    np.testing.assert_allclose(data_parameters(square, "centripetal", closed=True), [0, 1 / 3, 0.5, 5 / 6])
    np.testing.assert_allclose(data_parameters(square, "uniform"), [0, 1 / 3, 2 / 3, 1])
    with pytest.raises(GeometryError, match="point 1 coincides"):
        data_parameters(square[[0, 1, 1, 2]])


def test_arc_length_of_a_parabola():
    curve = BSplineCurve(2, clamped_uniform_knots(3, 2), np.array([[0, 0], [0.5, 0], [1, 1.0]]))  # y = x^2
    u = np.array([1.0, 0.25])
    lengths, total = arc_length_at(curve, u, n_nodes=20)
    exact = (2 * u * np.sqrt(1 + 4 * u**2) + np.arcsinh(2 * u)) / 4
    np.testing.assert_allclose(lengths, exact, rtol=1e-12)
    assert total == pytest.approx(exact[0])


def test_tolerance_is_kept_with_few_control_points():
    _, points = wave(600, True)

    def distance(n_control):
        return largest_distance(fit_curve(points, n_control=n_control, closed=True), points)

    counts = []
    for tolerance in (1e-2, 1e-3, 1e-4):
        counts.append(fewest_control_points(distance, tolerance, least=5, most=200))
        assert distance(counts[-1]) <= tolerance < distance(counts[-1] - 1)
    assert counts[0] < counts[1] < counts[2] < 120
    with pytest.raises(ConvergenceError, match=r"20 control points leave .* more than the tolerance 1e-09"):
        fewest_control_points(distance, 1e-9, least=5, most=20)


@given(st.integers(4, 30), st.integers(0, 200), st.integers(4, 250))
def test_the_fewest_are_found_and_both_ends_can_be_chosen(least, more, wanted):
    most = least + more
    if wanted > most:
        with pytest.raises(ConvergenceError, match=f"{most} control points"):
            fewest_control_points(lambda n: -float(n), -float(wanted), least=least, most=most)
    else:
        found = fewest_control_points(lambda n: -float(n), -float(wanted), least=least, most=most)
        assert found == max(least, wanted)


@pytest.mark.parametrize("closed", [False, True])
def test_a_gap_in_the_data_is_refused_unless_fairness_bridges_it(closed):
    u, points = wave(200, closed)
    keep = (u < 0.4) | (u > 0.7)
    with pytest.raises(GeometryError, match="unevenly spaced"):
        fit_curve(points[keep], n_control=40, closed=closed, parameters=u[keep])
    curve = fit_curve(points[keep], n_control=40, closed=closed, parameters=u[keep], fairness=1e-12)
    assert np.abs(curve_points(curve, u) - points).max() < 0.4
    with pytest.raises(GeometryError, match="cannot determine"):
        fit_curve(points[:20], n_control=40, closed=closed)
    with pytest.raises(GeometryError, match="increasing parameters"):
        fit_curve(points, n_control=20, closed=closed, parameters=u[::-1])

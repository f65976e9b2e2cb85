import numpy as np
import pytest

from ssmpipe.core.correspondence.normals import NormalFields, carried
from ssmpipe.core.correspondence.optimize import optimize_correspondence
from ssmpipe.core.correspondence.options import EngineOptions
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.evaluate import SplineStack
from ssmpipe.core.spline.fit import fit_surface
from ssmpipe.core.spline.surface import BSplineSurface
from tests.support.cohorts import line_bumps
from tests.support.surfaces import bump, wrapped

RNG = np.random.default_rng(4)
CLOSES = {"disk": (False, False), "tube": (True, False), "cone": (True, False), "closed": (True, False)}


def shape(kind):
    return bump((30.0, 27.0), 18.0) if kind == "disk" else wrapped(kind)


def exact(spline, periodic, parameters):
    jet = SplineStack([spline], periodic).evaluate(parameters[None])
    raw = np.cross(jet.first[0][0], jet.first[1][0])
    return raw / np.linalg.norm(raw, axis=1, keepdims=True)


@pytest.mark.parametrize("kind", list(CLOSES))
def test_the_field_is_the_normal_everywhere(kind):
    spline, periodic = shape(kind), CLOSES[kind]
    parameters = RNG.uniform(0.02, 0.98, size=(500, 2))
    both = NormalFields(spline, periodic).beside(spline, 5.0)
    found = SplineStack([both], periodic).evaluate(parameters[None]).points[0]
    np.testing.assert_array_equal(found[:, :3], SplineStack([spline], periodic).evaluate(parameters[None]).points[0])
    off = np.linalg.norm(found[:, 3:] / 5.0 - exact(spline, periodic, parameters), axis=1)
    assert np.sqrt((off**2).mean()) < 0.02
    assert off.max() < 0.1


@pytest.mark.parametrize("kind", ["tube", "cone", "closed"])
def test_the_field_closes_where_the_shape_does(kind):
    spline = shape(kind)
    control = NormalFields(spline, (True, False)).beside(spline, 1.0).control_points
    np.testing.assert_array_equal(control[0, :, 3:], control[-1, :, 3:])


@pytest.mark.parametrize(("degree", "n_control"), [(3, 4), (3, 5), (5, 6), (5, 8)])
def test_few_control_points_are_fitted_as_well(degree, n_control):
    t = np.linspace(0, 1, 60)
    x, y = np.meshgrid(t, t, indexing="ij")
    spline = fit_surface(
        np.stack([x, y, 0.1 * x * x + 0.2 * x * y], -1), n_control=(n_control, n_control), degree=(degree, degree)
    )
    parameters = RNG.uniform(0, 1, size=(200, 2))
    found = NormalFields(spline, (False, False)).at([spline], parameters[None])[0]
    assert np.linalg.norm(found - exact(spline, (False, False), parameters), axis=1).max() < 0.01


def test_the_spread_is_the_radius_of_a_sphere_and_a_circle_and_does_not_grow_with_length():
    u, v = np.meshgrid(np.linspace(0, 1, 97), np.linspace(0, 1, 97), indexing="ij")
    angle, polar = 2 * np.pi * u, np.pi * (1 - v)
    ball = np.stack([np.sin(polar) * np.cos(angle), np.sin(polar) * np.sin(angle), np.cos(polar)], -1) * 7.0
    ball[-1] = ball[0]
    sphere = fit_surface(ball, n_control=(40, 40))
    np.testing.assert_allclose(NormalFields(sphere, (True, False)).spread([sphere]), 7.0, rtol=1e-3)
    spreads = []
    for length in (60.0, 600.0):
        tube = np.stack([7.0 * np.cos(angle), 7.0 * np.sin(angle), length * v], -1)
        tube[-1] = tube[0]
        spline = fit_surface(tube, n_control=(40, 12))
        spreads.append(NormalFields(spline, (True, False)).spread([spline]))
    np.testing.assert_allclose(spreads, 7.0 * np.sqrt(1.5), rtol=1e-3)


def test_normals_are_carried_by_linear_maps():
    spline = shape("disk")
    linear = np.array([[1.2, 0.3, 0.0], [0.0, 0.8, 0.1], [0.2, 0.0, 1.1]])
    moved = BSplineSurface(spline.degree, spline.knots_u, spline.knots_v, spline.control_points @ linear.T)
    parameters = RNG.uniform(0, 1, size=(50, 2))
    n = exact(spline, (False, False), parameters)
    np.testing.assert_allclose(carried(n[None], linear[None])[0], exact(moved, (False, False), parameters), atol=1e-12)


def test_tangents_are_carried_by_linear_maps():
    curve = line_bumps(1, tilt=0.1)[0]
    linear = np.array([[1.2, 0.5], [-0.1, 0.8]])
    moved = curve.with_control(curve.control_points @ linear.T)
    first = [SplineStack([s]).evaluate(np.linspace(0, 1, 20)[None, :, None]).first[0][0] for s in (curve, moved)]
    before, after = (t / np.linalg.norm(t, axis=1, keepdims=True) for t in first)
    np.testing.assert_allclose(carried(before[None], linear[None], tangents=True)[0], after, atol=1e-12)


def test_the_weight_counts_spreads_and_the_field_moves_with_the_shape():
    spline = shape("disk")
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    larger = BSplineSurface(spline.degree, spline.knots_u, spline.knots_v, 3.0 * spline.control_points @ turn.T)
    fields = NormalFields(spline, (False, False))
    np.testing.assert_allclose(fields.spread([larger]), 3.0 * fields.spread([spline]))
    turned = fields.beside(larger, 1.0).control_points[..., 3:]
    np.testing.assert_allclose(turned, fields.beside(spline, 1.0).control_points[..., 3:] @ turn.T, atol=1e-12)


def test_surfaces_in_the_plane_are_refused():
    knots = np.array([0, 0, 1, 1.0])
    with pytest.raises(GeometryError, match="no normals"):
        NormalFields(BSplineSurface((1, 1), knots, knots, np.zeros((2, 2, 2))), (False, False))


@pytest.mark.parametrize("normals", [-1.0, float("nan"), float("inf")])
def test_weights_that_are_no_weights_are_refused(normals):
    with pytest.raises(GeometryError, match=r"normals is .*, it must be 0 or more"):
        optimize_correspondence([shape("disk"), bump((27.0, 30.0), 15.0)], EngineOptions(normals=normals))


def test_normals_find_the_flanks_that_positions_leave_free():
    """Terraces whose edge lies elsewhere: the same place is the same height; true edges are known."""
    t = np.linspace(0, 1, 96)

    def terrace(edge):
        x, y = np.meshgrid(60 * t, 60 * t, indexing="ij")
        return fit_surface(np.stack([x, y, 4 / (1 + np.exp(-(x - edge) / 1.5))], axis=-1), n_control=(24, 24))

    edges = np.array([24.0, 27.0, 30.0, 33.0, 36.0])
    found = {}
    for normals in (0.0, 0.8):
        options = EngineOptions(n_coefficients=(8, 6), normals=normals, normalize="none", pose="keep", reference=2)
        points = optimize_correspondence([terrace(e) for e in edges], options).value.points.reshape(5, 51, 51, 3)
        middle = points[:, :, 25]
        crossing = [np.interp(2.0, row[:, 2], np.arange(51)) for row in middle]
        found[normals] = float(np.std(crossing))
    assert found[0.8] < 0.8 * found[0.0], found

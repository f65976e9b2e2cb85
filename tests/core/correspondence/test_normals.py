import numpy as np
import pytest

from ssmpipe.core.correspondence.normals import NormalFields, grid_normals
from ssmpipe.core.correspondence.optimize import EngineOptions, optimize_correspondence
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.evaluate import SplineStack
from ssmpipe.core.spline.fit import fit_surface
from ssmpipe.core.spline.surface import BSplineSurface
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


@pytest.mark.parametrize("kind", list(CLOSES))
def test_differences_on_a_grid_agree(kind):
    spline, periodic = shape(kind), CLOSES[kind]
    nodes = [np.linspace(0, 1, 81, endpoint=not p) for p in periodic]
    at = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1).reshape(-1, 2)
    points = SplineStack([spline], periodic).evaluate(at[None]).points[0]
    normals, area = grid_normals(points, (81, 81), periodic)
    fields = NormalFields(spline, periodic)
    inside = (at[:, 1] > 0.03) & (at[:, 1] < 0.97)
    assert np.linalg.norm(normals - exact(spline, periodic, np.clip(at, 1e-3, 1 - 1e-3)), axis=1)[inside].max() < 0.1
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-12)  # poles included
    np.testing.assert_allclose(np.sqrt(area / (4 * np.pi)), fields.radius([spline]), rtol=2e-3)


def test_the_weight_counts_radii_and_moves_with_the_shape():
    spline = shape("disk")
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    larger = BSplineSurface(spline.degree, spline.knots_u, spline.knots_v, 3.0 * spline.control_points @ turn.T)
    fields = NormalFields(spline, (False, False))
    np.testing.assert_allclose(fields.radius([larger]), 3.0 * fields.radius([spline]))
    turned = fields.beside(larger, 1.0).control_points[..., 3:]
    np.testing.assert_allclose(turned, fields.beside(spline, 1.0).control_points[..., 3:] @ turn.T, atol=1e-12)


def test_surfaces_in_the_plane_are_refused():
    knots = np.array([0, 0, 1, 1.0])
    with pytest.raises(GeometryError, match="no normals"):
        NormalFields(BSplineSurface((1, 1), knots, knots, np.zeros((2, 2, 2))), (False, False))


def test_normals_find_the_flanks_that_positions_leave_free():
    """Terraces whose edge lies elsewhere: the same place is the same height; true edges are known."""
    t = np.linspace(0, 1, 96)

    def terrace(edge):
        x, y = np.meshgrid(60 * t, 60 * t, indexing="ij")
        return fit_surface(np.stack([x, y, 4 / (1 + np.exp(-(x - edge) / 1.5))], axis=-1), n_control=(24, 24))

    edges = np.array([24.0, 27.0, 30.0, 33.0, 36.0])
    found = {}
    for normals in (0.0, 0.7):
        options = EngineOptions(n_coefficients=(8, 6), normals=normals, normalize="none", pose="keep", reference=2)
        points = optimize_correspondence([terrace(e) for e in edges], options).value.points.reshape(5, 51, 51, 3)
        middle = points[:, :, 25]
        crossing = [np.interp(2.0, row[:, 2], np.arange(51)) for row in middle]
        found[normals] = float(np.std(crossing))
    assert found[0.7] < 0.8 * found[0.0], found

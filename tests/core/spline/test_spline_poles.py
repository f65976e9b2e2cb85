from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.spline.fit import fit_surface, surface_grid
from ssmpipe.core.spline.poles import is_pole, smooth_pole, surface_topology, tangent_plane
from ssmpipe.core.spline.surface import BSplineSurface
from tests.support.surfaces import wrapped


def turned(surface: BSplineSurface, row: int, order) -> BSplineSurface:
    control = surface.control_points.copy()
    control[:, row] = control[order, row]
    return BSplineSurface(surface.degree, surface.knots_u, surface.knots_v, control)


@pytest.mark.parametrize(("kind", "n_poles"), [("tube", 0), ("cone", 1), ("closed", 2)])
def test_topology_is_read_from_the_control_points(kind, n_poles):
    surface = wrapped(kind)
    assert surface_topology(surface) == kind
    assert sum(is_pole(surface, end) for end in (0, -1)) == n_poles
    opened = surface.control_points.copy()
    opened[-1, 3] += 1e-6
    assert surface_topology(BSplineSurface(surface.degree, surface.knots_u, surface.knots_v, opened)) == "disk"


def test_poles_of_an_ellipsoid_have_the_tangent_plane_of_the_axis():
    surface = wrapped("closed", bump=0.0)
    for end, z in ((0, -1.0), (-1, 1.0)):
        plane = tangent_plane(surface, end)
        assert plane.normal == pytest.approx([0, 0, z], abs=1e-3)
        assert plane.deviation_deg < 1e-9
        assert 0.7 < plane.winding < 1.0  # 1 for a circle, 0.9 for the axes 1 : 0.9


def test_an_uneven_pole_becomes_smooth_and_a_folded_one_is_found():
    rough = wrapped("cone", smooth=False)
    assert tangent_plane(rough, -1).deviation_deg > 0.01
    turn = np.linspace(0, 2 * np.pi, 101)
    samples = np.repeat(np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)[:, None], 8, axis=1)
    n_control = (len(rough.control_points), 4)
    circle = fit_surface(samples, degree=(rough.degree[0], 1), n_control=n_control).control_points[:, 0, :2]
    flat = smooth_pole(rough.control_points, -1, circle)
    assert np.array_equal(flat[0], flat[-1])
    assert np.array_equal(np.delete(flat, -2, axis=1), np.delete(rough.control_points, -2, axis=1))
    surface = BSplineSurface(rough.degree, rough.knots_u, rough.knots_v, flat)
    assert tangent_plane(surface, -1).deviation_deg < 1e-9
    assert tangent_plane(surface, -1).winding > 0.5
    order = np.arange(len(flat))
    order[[5, 8]] = order[[8, 5]]
    assert tangent_plane(turned(surface, -2, order), -1).winding < 0


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_a_surface_that_closes_is_as_smooth_at_the_seam_as_elsewhere(degree):
    def slope_jump(surface):
        eps = 1e-6
        row = surface_grid(surface, 2, 7)[0]
        first, last = ((evaluate(surface, u) - row) / (u if u < 0.5 else u - 1.0) for u in (eps, 1.0 - eps))
        return np.abs(first - last).max() / np.abs(first).max()

    def evaluate(surface, u):
        from ssmpipe.core.spline.basis import design_matrix

        b_u = design_matrix(np.array([u]), surface.knots_u, surface.degree[0])
        b_v = design_matrix(np.linspace(0, 1, 7), surface.knots_v, surface.degree[1])
        return np.einsum("ka,abd,lb->kld", b_u, surface.control_points, b_v)[0]

    smooth, kept = wrapped("tube", degree=degree, n=12), wrapped("tube", degree=degree, n=12, smooth=False)
    for surface in (smooth, kept):
        assert np.array_equal(surface.control_points[0], surface.control_points[-1])
    if degree > 1:
        assert slope_jump(smooth) < 1e-4 < 1e-2 < slope_jump(kept)


def test_smoothing_the_seam_does_not_cost_accuracy():
    from tests.support.surfaces import wrapped_samples

    dense = wrapped_samples("tube", 201)
    rms = [
        np.sqrt(
            ((surface_grid(fit_surface(dense[::2, ::2], n_control=(24, 24), smooth=s), 201, 201) - dense) ** 2).mean()
        )
        for s in (True, False)
    ]
    assert rms[0] < 1.05 * rms[1] < 0.02

from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.align.rigid import apply, move, reflection
from ssmpipe.core.errors import TopologyError
from ssmpipe.core.mesh.primitives import sphere, star_shape, tube
from ssmpipe.core.mesh.topology import euler_characteristic
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.parameterize.cone import PoleMap, parameterize_poles
from ssmpipe.core.parameterize.periodic import folded_periodic, periodic_stretch, squared_derivatives
from ssmpipe.core.parameterize.poles import apex_of
from ssmpipe.core.parameterize.sampling import sample_grid
from ssmpipe.core.repair.trimming import trim
from tests.support.meshes import noisy, random_motion, relabeled

X, Y, Z = np.eye(3)


def cap() -> TriMesh:
    return trim(star_shape(4), -10.0 * Z, -Z)


def cone_surface(radius: float = 10.0, slope: float = 2.0, n_around: int = 64, n_along: int = 40) -> TriMesh:
    """Return a circular cone with its tip up, outward."""
    body = tube(1.0, 1.0, n_around, n_along)
    # the last ring becomes the tip: its vertices are merged
    t = body.vertices[:, 2]
    points = np.column_stack([radius * (1 - t[:, None]) * body.vertices[:, :2], slope * radius * t])
    ring = np.flatnonzero(t > 1 - 1e-9)
    faces = np.where(np.isin(body.faces, ring), ring[0], body.faces)
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    used, faces = np.unique(faces, return_inverse=True)
    return TriMesh(points[used], faces.reshape(-1, 3))


def grid(found: PoleMap, n_u: int = 33, n_v: int = 17) -> np.ndarray:
    return sample_grid(found.mesh, found.uv, n_u, n_v, found.seam)


def check(found: PoleMap) -> None:
    left, right = found.seam.pairs.T
    assert found.uv[right] == pytest.approx(found.uv[left] + [1.0, 0.0], abs=1e-12)
    assert euler_characteristic(found.mesh.faces) == 1
    assert not folded_periodic(found.mesh, found.uv, found.seam.poles).any()
    assert found.uv[found.seam.poles[-1], 1] == 1.0
    assert found.uv[:, 1].min() == 0.0


def test_a_ball_maps_to_longitude_and_latitude():
    ball = sphere(10.0, 4)
    found = parameterize_poles(ball, 10 * Z, -10 * Z, max_iterations=0, n_remap=0)
    check(found)
    p = found.mesh.vertices
    inner = (np.abs(p[:, 2]) < 9.0) & ~np.isin(np.arange(len(p)), found.seam.poles)
    longitude = np.exp(2j * np.pi * found.uv[inner, 0])
    assert np.abs(longitude - (p[inner, 1] - 1j * p[inner, 0]) / np.hypot(p[inner, 0], p[inner, 1])).max() < 0.02
    # conformal from the ball to the cylinder: the Mercator ordinate, up to the scale that the poles' faces decide
    mercator = np.arctanh(p[inner, 2] / 10.0)
    slope = np.linalg.lstsq(mercator[:, None], found.uv[inner, 1] - 0.5, rcond=None)[0][0]
    assert found.uv[inner, 1] - 0.5 == pytest.approx(slope * mercator, abs=2e-3)
    # the poles' faces span much of v; the relaxed map spreads them
    assert found.ring.min() > 0.05
    better = parameterize_poles(ball, 10 * Z, -10 * Z)
    check(better)
    assert better.ring.max() < 0.03
    # sampled to equal weight in both directions: v is symmetric and increases with z
    relaxed = better.uv[np.argsort(better.mesh.vertices[:, 2]), 1]
    assert np.corrcoef(relaxed, np.sort(better.mesh.vertices[:, 2]))[0, 1] > 0.98
    assert better.stretch[-1] < 1.11
    assert (np.diff(better.stretch) < 0).all()


def test_a_cone_unrolls_as_expected():
    surface = cone_surface()
    tip = surface.vertices[np.argmax(surface.vertices[:, 2])]
    found = parameterize_poles(surface, tip, max_iterations=0, n_remap=0)
    check(found)
    inner = ~np.isin(np.arange(found.mesh.n_vertices), found.seam.poles)
    p, (u, v) = found.mesh.vertices[inner], found.uv[inner].T
    angle = np.exp(2j * np.pi * u) / ((p[:, 1] - 1j * p[:, 0]) / np.hypot(p[:, 0], p[:, 1]))
    assert np.abs(angle - 1.0).max() < 0.02
    # harmonic without angle: v is linear in the logarithm of the distance to the tip
    distance = np.log(np.linalg.norm(p - tip, axis=1))
    line = np.polyfit(distance, v, 1)
    away = distance > distance.max() - 2.0
    assert v[away] == pytest.approx(np.polyval(line, distance)[away], abs=0.01)
    # for the plain functions of v the best one is known: |S_t|^2 integrated is least for t ~ r^(4/3)
    better = parameterize_poles(surface, tip, max_iterations=0, n_remap=16)
    check(better)
    share = np.linalg.norm(better.mesh.vertices[inner] - tip, axis=1) / np.linalg.norm(surface.vertices[0] - tip)
    assert better.uv[inner, 1] == pytest.approx(1.0 - share ** (4 / 3), abs=0.02)


def test_the_seam_runs_where_it_is_told():
    ball = sphere(10.0, 4)
    for direction in (X, Y, X - Y):
        found = parameterize_poles(ball, 10 * Z, -10 * Z, seam_direction=direction)
        assert grid(found)[0, 8] == pytest.approx(10 * direction / np.linalg.norm(direction), abs=0.1)
    point = np.array([6.0, -6.0, 5.0])
    found = parameterize_poles(ball, 10 * Z, -10 * Z, seam_point=point)
    seam = grid(found, 9, 200)[0]
    assert np.linalg.norm(seam - 10 * point / np.linalg.norm(point), axis=1).min() < 0.2


@pytest.mark.parametrize("closed", [False, True])
def test_pose_and_numbering_change_nothing(closed):
    rng = np.random.default_rng(3)
    mesh = star_shape(4) if closed else cap()
    apex = apex_of(cap())
    antapex = mesh.vertices[np.argmin(mesh.vertices[:, 2])] if closed else None
    found = parameterize_poles(mesh, apex, antapex)
    check(found)
    motion = random_motion(rng)
    shuffled, _ = relabeled(move(mesh, motion), rng)
    poles = [None if p is None else apply(motion, p[None])[0] for p in (apex, antapex)]
    other = parameterize_poles(shuffled, *poles, seam_direction=motion[:3, :3] @ Y)
    check(other)
    assert grid(other) == pytest.approx(apply(motion, grid(found).reshape(-1, 3)).reshape(33, 17, 3), abs=1e-5)


def test_a_mirror_image_runs_the_other_way():
    apex = apex_of(cap())
    found = parameterize_poles(cap(), apex)
    mirror = reflection(0)
    other = parameterize_poles(move(cap(), mirror), apply(mirror, apex[None])[0], seam_direction=Y)
    expected = apply(mirror, grid(found)[::-1].reshape(-1, 3)).reshape(33, 17, 3)
    assert grid(other) == pytest.approx(expected, abs=1e-5)


def test_noise_does_not_fold_the_map():
    rough = noisy(cap(), np.random.default_rng(4), 1.5)
    found = parameterize_poles(rough, apex_of(cap()))
    check(found)
    assert found.n_folds_harmonic > 0
    assert found.settled


def test_derivatives_of_a_flat_sheet():
    # 3 mm per unit of u and 4 mm per unit of v
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    sheet = TriMesh(np.column_stack([3 * uv[:, 0], 4 * uv[:, 1], np.zeros(4)]), np.array([[0, 1, 2], [0, 2, 3]]))
    square_u, square_v = squared_derivatives(sheet, uv, ())
    assert square_u == pytest.approx([9.0, 9.0])
    assert square_v == pytest.approx([16.0, 16.0])
    assert periodic_stretch(sheet, uv, ()) == pytest.approx(1.0)
    assert folded_periodic(sheet, uv * [-1, 1], ()).all()
    # a patch at a pole: the edge has 3 mm per unit of u, the pole is 4 mm away; |S_u| falls to 0
    patch = TriMesh(np.array([[0, 0, 0], [3, 0, 0], [1.5, 4, 0.0]]), np.array([[0, 1, 2]]))
    square_u, square_v = squared_derivatives(patch, np.array([[0, 0], [1, 0], [0.5, 1.0]]), (2,))
    assert square_u == pytest.approx([4.5])
    assert square_v == pytest.approx([16.0])


def test_samples_close_exactly_and_lie_on_the_surface():
    found = parameterize_poles(cap(), apex_of(cap()))
    samples = grid(found, 60, 50)
    assert np.array_equal(samples[0], samples[-1])
    assert (samples[:, -1] == samples[0, -1]).all()
    assert samples[:, 0, 2] == pytest.approx(-10.0)
    ball = parameterize_poles(sphere(10.0, 4), 10 * Z, -10 * Z)
    assert np.linalg.norm(grid(ball, 60, 50), axis=2) == pytest.approx(10.0, abs=0.04)
    assert np.ptp(grid(ball, 60, 50)[:, 0], axis=0) == pytest.approx(np.zeros(3))


def test_other_surfaces_are_refused():
    with pytest.raises(TopologyError, match=r"2 boundary loops, a map to the square needs exactly one"):
        parameterize_poles(tube(), X)
    with pytest.raises(TopologyError, match=r"1 boundary loops, a closed one is needed.*cone"):
        parameterize_poles(cap(), apex_of(cap()), -X)
    with pytest.raises(TopologyError, match=r"same place"):
        parameterize_poles(sphere(10.0, 2), 10 * Z, 11 * Z)

from __future__ import annotations

import re

import numpy as np
import pytest

from ssmpipe.core.align.rigid import apply, move
from ssmpipe.core.errors import GeometryError, TopologyError
from ssmpipe.core.mesh.distance import point_to_mesh
from ssmpipe.core.mesh.operators import area
from ssmpipe.core.mesh.primitives import sphere, star_shape, tube
from ssmpipe.core.mesh.topology import euler_characteristic
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.parameterize.cone import PoleMap, parameterize_poles, u_at
from ssmpipe.core.parameterize.periodic import folded_periodic
from ssmpipe.core.parameterize.poles import apex_of
from ssmpipe.core.parameterize.sampling import sample_grid
from ssmpipe.core.parameterize.traced import parameterize_traced
from ssmpipe.core.repair.trimming import trim
from tests.support.meshes import noisy, random_motion, relabeled

X, Y, Z = np.eye(3)


def dome(subdivisions: int = 4) -> TriMesh:
    return trim(sphere(10.0, subdivisions), -3.0 * Z, -Z)


def cap() -> TriMesh:
    return trim(star_shape(4), -10.0 * Z, -Z)


def grid(found: PoleMap) -> np.ndarray:
    return sample_grid(found.mesh, found.uv, 33, 17, found.seam)


def check(found: PoleMap, mesh: TriMesh) -> None:
    left, right = found.seam.pairs.T
    assert np.array_equal(found.uv[left, 0], np.zeros(len(left)))
    assert np.array_equal(found.uv[right], found.uv[left] + [1.0, 0.0])
    assert (np.diff(found.uv[left, 1]) > 0).all()
    assert euler_characteristic(found.mesh.faces) == 1
    assert not folded_periodic(found.mesh, found.uv, found.seam.poles).any()
    assert area(found.mesh) == pytest.approx(area(mesh), rel=1e-9)
    assert (found.uv[:, 1].min(), found.uv[:, 1].max()) == (0.0, 1.0)


def round_cone() -> TriMesh:
    """Return a circular cone, 10 mm wide and 20 mm high, its tip up."""
    body = tube(1.0, 1.0, 64, 40)
    t = body.vertices[:, 2]
    points = np.column_stack([10.0 * (1 - t[:, None]) * body.vertices[:, :2], 20.0 * t])
    ring = np.flatnonzero(t > 1 - 1e-9)
    faces = np.where(np.isin(body.faces, ring), ring[0], body.faces)
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    used, faces = np.unique(faces, return_inverse=True)
    return TriMesh(points[used], faces.reshape(-1, 3))


@pytest.mark.parametrize("kind", ["ball", "cone"])
def test_on_round_surfaces_it_equals_the_periodic_solve(kind):
    mesh, tip = (dome(), 10.0 * Z) if kind == "ball" else (round_cone(), 20.0 * Z)
    found = parameterize_traced(mesh, tip, n_remap=0)
    check(found, mesh)
    if kind == "cone":
        assert found.kink == pytest.approx(1.0, abs=1e-9)
    p, (u, v) = found.mesh.vertices, found.uv.T
    # within the first rings of faces around the tip the lines follow edges
    away = np.hypot(p[:, 0], p[:, 1]) > 3.0
    # u is the longitude from y on, counter-clockwise from above
    longitude = (p[:, 1] - 1j * p[:, 0])[away] / np.hypot(p[:, 0], p[:, 1])[away]
    assert np.abs(np.exp(2j * np.pi * u[away]) - longitude).max() < 0.02
    periodic = parameterize_poles(mesh, tip, max_iterations=0, n_remap=0)
    assert np.linalg.norm(grid(found) - grid(periodic), axis=2)[:, :-1].max() < 0.4
    # the vertices of the mesh come first in both
    n = mesh.n_vertices
    assert v[:n] == pytest.approx(periodic.uv[:n, 1], abs=1e-3)


def test_it_converges_to_the_longitude():
    errors = []
    for subdivisions in (3, 4, 5):
        found = parameterize_traced(dome(subdivisions), 10.0 * Z, n_remap=0)
        x, y = found.mesh.vertices[:, :2].T
        away = np.hypot(x, y) > 3.0
        wrong = np.angle(np.exp(2j * np.pi * found.uv[away, 0]) * (y + 1j * x)[away])
        errors.append(float(np.sqrt((wrong**2).mean())))
    assert errors[2] < 0.6 * errors[1] < 0.36 * errors[0]


def test_the_opposite_line_has_a_half_and_u_and_v_are_changed():
    found = parameterize_traced(cap(), apex_of(cap()), n_remap=0)
    check(found, cap())
    halves = np.flatnonzero(found.uv[:, 0] == 0.5)
    assert len(halves) > 20
    # from the rim to the vertex before the apex
    order = halves[np.argsort(found.uv[halves, 1])]
    assert found.uv[order[0], 1] == 0.0
    # half way around the rim by arc length
    rim = np.flatnonzero(found.uv[:, 1] == 0.0)
    rim = rim[np.argsort(found.uv[rim, 0])]
    length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(found.mesh.vertices[rim], axis=0), axis=1)))
    assert length[np.flatnonzero(rim == order[0])[0]] == pytest.approx(0.5 * length[-1], rel=1e-2)
    remapped = parameterize_traced(cap(), apex_of(cap()))
    assert remapped.stretch[-1] < remapped.stretch[0]
    assert remapped.ring[0] < 0.03 < remapped.ring_before[0]
    assert not folded_periodic(remapped.mesh, remapped.uv, remapped.seam.poles).any()


def test_regions_of_unequal_width_make_a_kink():
    # the cap is conformal to a disk of radius tan(t / 2), t the angle from the top to the rim; seen from an apex towards +y the half of the
    # rim on that side takes this share of the whole angle (Moebius' map of the disk that moves the apex to its center)
    apex = 10.0 * np.array([0.0, 0.6, 0.8])
    offset = np.tan(0.5 * np.arccos(0.8)) / np.tan(0.5 * np.arccos(-0.3))
    share = 0.5 + 2.0 * np.arctan(offset) / np.pi
    found = parameterize_traced(dome(), apex, seam_direction=X, n_remap=0)
    check(found, dome())
    # the flows through the regions tell it, to the accuracy of the lines beside the apex; here it ends at one half nevertheless
    assert found.kink / (1.0 + found.kink) == pytest.approx(share, abs=0.03)
    # the periodic solve has no kink, the opposite line lies at the share itself
    rim = np.flatnonzero(found.uv[:, 1] == 0.0)
    seam, opposite = (found.mesh.vertices[rim[found.uv[rim, 0] == u][0]] for u in (0.0, 0.5))
    periodic = parameterize_poles(dome(), apex, max_iterations=0, n_remap=0)
    start, end = (u_at(periodic.mesh, periodic.uv, place) for place in (seam, opposite))
    assert (end - start) % 1.0 == pytest.approx(share, abs=0.01)


def test_the_seam_starts_where_it_is_told():
    for direction in (X, X - Y):
        found = parameterize_traced(dome(), 10 * Z, seam_direction=direction, n_remap=0)
        begin = found.mesh.vertices[found.seam.pairs[0, 0]]
        across = np.sqrt(91.0) * direction / np.linalg.norm(direction)
        assert begin == pytest.approx(across - 3 * Z, abs=0.1)
    found = parameterize_traced(dome(), 10 * Z, seam_point=np.array([6.0, -6.0, 5.0]), n_remap=0)
    seam = found.mesh.vertices[found.seam.pairs[:, 0]]
    assert np.linalg.norm(seam - 10 * np.array([6.0, -6.0, 5.0]) / np.sqrt(97.0), axis=1).min() < 1.0


def test_pose_and_numbering_change_nothing():
    rng = np.random.default_rng(3)
    apex = apex_of(cap())
    found = parameterize_traced(cap(), apex)
    motion = random_motion(rng)
    shuffled, _ = relabeled(move(cap(), motion), rng)
    other = parameterize_traced(shuffled, apply(motion, apex[None])[0], seam_direction=motion[:3, :3] @ Y)
    assert grid(other) == pytest.approx(apply(motion, grid(found).reshape(-1, 3)).reshape(33, 17, 3), abs=1e-5)


def test_folds_are_mended_or_counted_with_their_place():
    apex, n_mended = apex_of(cap()), 0
    for seed in range(4):
        rough = noisy(cap(), np.random.default_rng(seed), 0.4)
        found = parameterize_traced(rough, apex)
        assert not folded_periodic(found.mesh, found.uv, found.seam.poles).any()
        n_mended += found.n_folds_harmonic
    assert n_mended > 0
    facts = []
    for seed in range(4):
        with pytest.raises(GeometryError, match=r"use cone: periodic") as caught:
            parameterize_traced(noisy(cap(), np.random.default_rng(seed), 1.0), apex)
        facts.append(str(caught.value))
        place = [float(x) for x in re.findall(r"-?\d+\.\d", facts[-1])]
        assert point_to_mesh(np.array([place[:3]]), cap())[0][0] < 5.0
    folds = [
        fact for fact in facts if re.match(r"\d+ of \d+ triangles are turned over in the square, the first at", fact)
    ]
    assert folds
    assert all(fact in folds or fact.startswith("a gradient line ends before the apex") for fact in facts)


def test_lines_that_meet_are_refused():
    # close to the rim both lines come to the apex from the same side
    with pytest.raises(GeometryError, match=r"lines meet before the apex, at \(.*\) mm.*use cone: periodic"):
        parameterize_traced(dome(3), 10.0 * np.array([0.9, 0.0, 0.2]))


def test_other_surfaces_are_refused():
    with pytest.raises(TopologyError, match=r"2 boundary loops, a map to the square needs exactly one"):
        parameterize_traced(tube(), X)

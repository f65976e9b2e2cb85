from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.align.rigid import move
from ssmpipe.core.errors import TopologyError
from ssmpipe.core.mesh.distance import surface_deviation
from ssmpipe.core.mesh.operators import volume
from ssmpipe.core.mesh.primitives import flat_square, sphere, star_shape, torus, tube
from ssmpipe.core.mesh.topology import boundary_loops, euler_characteristic, genus, is_manifold, loop_length
from ssmpipe.core.repair import decimation
from ssmpipe.core.repair.decimation import decimate
from ssmpipe.core.repair.smoothing import neighbour_average, taubin
from tests.support.meshes import noisy, random_motion, relabeled


def test_taubin_removes_noise_without_shrinking():
    ball = sphere(30.0, 5)
    rough = noisy(ball, np.random.default_rng(0), 0.3)
    smooth = taubin(rough, n_iterations=10)
    radial = [np.std(np.linalg.norm(m.vertices, axis=1)) for m in (rough, smooth)]
    assert radial[1] < 0.45 * radial[0]
    assert volume(smooth) == pytest.approx(volume(ball), rel=3e-3)


def test_taubin_keeps_planes_commutes_with_motions_and_relabeling():
    flat = taubin(flat_square(12))
    assert flat.vertices[:, 2] == pytest.approx(0.0)
    lump, rng = star_shape(3), np.random.default_rng(1)
    motion = random_motion(rng)
    shuffled, new = relabeled(lump, rng)
    expected = taubin(lump).vertices
    assert taubin(move(lump, motion)).vertices == pytest.approx(move(taubin(lump), motion).vertices)
    assert taubin(shuffled).vertices[new] == pytest.approx(expected)


def test_rim_is_averaged_along_itself_only():
    pipe = tube()
    average = neighbour_average(pipe)
    rim = np.unique(np.concatenate(boundary_loops(pipe.faces)))
    inner = np.setdiff1d(np.arange(pipe.n_vertices), rim)
    assert abs(average[rim][:, inner]).sum() == 0
    assert np.asarray(average.sum(axis=1)) == pytest.approx(1.0)
    smooth = taubin(pipe)
    assert np.ptp(smooth.vertices[:, 2]) == pytest.approx(4.0)


@pytest.mark.parametrize(
    "mesh", [sphere(10.0, 4), torus(), tube(), star_shape()], ids=["sphere", "torus", "tube", "star"]
)
def test_decimation_keeps_topology_and_shape(mesh):
    result = decimate(mesh, 800)
    small = result.mesh
    assert result.method == "quadric"
    assert 790 <= small.n_faces <= 800
    assert is_manifold(small.faces)
    assert (euler_characteristic(small.faces), genus(small.faces)) == (
        euler_characteristic(mesh.faces),
        genus(mesh.faces),
    )
    assert volume(small) == pytest.approx(volume(mesh), rel=0.03)
    size = float(np.ptp(mesh.vertices, axis=0).max())
    assert surface_deviation(mesh, small, 2000).maximum < 0.03 * size


def test_decimation_keeps_the_boundary_when_asked_and_small_meshes():
    pipe = tube()
    kept = decimate(pipe, 800, keep_boundary=True).mesh
    assert [loop_length(kept, b) for b in boundary_loops(kept.faces)] == pytest.approx(
        [loop_length(pipe, b) for b in boundary_loops(pipe.faces)]
    )
    assert decimate(pipe, pipe.n_faces).mesh is pipe


def test_careful_method_takes_over_when_the_fast_one_tears(monkeypatch):
    ball = sphere(10.0, 3)

    def tear(vertices, faces, **_):
        return vertices, faces[:300]

    monkeypatch.setattr(decimation.fast_simplification, "simplify", tear)
    result = decimate(ball, 500)
    assert result.method == "qslim"
    assert euler_characteristic(result.mesh.faces) == 2
    monkeypatch.setattr(decimation.igl, "qslim", lambda v, f, n: (v, f[:300]))
    with pytest.raises(TopologyError, match=r"another topology"):
        decimate(ball, 500)

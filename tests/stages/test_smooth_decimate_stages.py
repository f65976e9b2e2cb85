from __future__ import annotations

import importlib
import logging
import sys

import numpy as np
import pytest
from pydantic import ValidationError

from ssmpipe.contract import Context
from ssmpipe.core.errors import ConfigError
from ssmpipe.core.mesh.primitives import star_shape, tube
from ssmpipe.core.mesh.topology import boundary_half_edges, boundary_loops, euler_characteristic
from ssmpipe.stages import decimate, smooth
from tests.support.meshes import noisy


def go(stage, mesh, **options):
    ctx = Context("shape", np.random.default_rng(0), logging.getLogger("test"))
    return stage.run(mesh, cfg=stage.Config(**options), ctx=ctx)["mesh"], ctx


def has_pymeshlab() -> bool:
    try:
        importlib.import_module("pymeshlab")
    except ImportError:
        return False
    return True


needs_pymeshlab = pytest.mark.skipif(not has_pymeshlab(), reason="PyMeshLab cannot be loaded here (libgl1, libopengl0)")


@pytest.mark.parametrize(
    "method", ["taubin", "bilaplacian", "curvature-flow", pytest.param("pymeshlab", marks=needs_pymeshlab)]
)
def test_every_way_of_smoothing_reports_what_changed(method):
    pipe = noisy(tube(10.0, 40.0), np.random.default_rng(0), 0.2)
    done, ctx = go(smooth, pipe, method=method)
    assert np.array_equal(done.faces, pipe.faces)
    inner = np.abs(pipe.vertices[:, 2] - 20.0) < 10.0  # the flow shrinks the middle more than the rims
    assert np.std(np.hypot(*done.vertices[inner].T[:2])) < 0.7 * np.std(np.hypot(*pipe.vertices[inner].T[:2]))
    assert ctx.metrics["area_change_percent"] < 0
    assert abs(ctx.metrics["volume_change_percent"]) < (10.0 if method == "curvature-flow" else 1.0)
    assert 0 < ctx.metrics["deviation_rms_mm"] < ctx.metrics["deviation_max_mm"]
    assert 0 < ctx.metrics["rim_moved_rms_mm"] < 0.4


@pytest.mark.parametrize("method", ["taubin", "bilaplacian", "curvature-flow"])
def test_the_boundary_stays_when_asked(method):
    pipe = noisy(tube(10.0, 40.0), np.random.default_rng(0), 0.2)
    done, ctx = go(smooth, pipe, method=method, boundary="fixed")
    rim = np.unique(boundary_half_edges(pipe.faces))
    assert np.array_equal(done.vertices[rim], pipe.vertices[rim])
    assert ctx.metrics["rim_moved_rms_mm"] == 0.0
    with pytest.raises(ValidationError, match="boundary: fixed is not available"):
        smooth.Config(method="pymeshlab", boundary="fixed")


@pytest.mark.parametrize("method", ["fast-simplification", "qslim", pytest.param("pymeshlab", marks=needs_pymeshlab)])
def test_every_way_of_decimating_keeps_topology_and_reports_both_directions(method):
    pipe = noisy(tube(10.0, 40.0, n_around=60, n_along=60), np.random.default_rng(0), 0.01)
    done, ctx = go(decimate, pipe, n_faces=1500, method=method)
    assert done.n_faces <= 1517
    assert euler_characteristic(done.faces) == 0
    assert len(boundary_loops(done.faces)) == 2
    m = ctx.metrics
    assert m["n_faces_before"] == pipe.n_faces
    assert m["deviation_max_mm"] == max(m["before_to_after_max_mm"], m["after_to_before_max_mm"])
    assert min(m["before_to_after_rms_mm"], m["after_to_before_rms_mm"]) <= m["deviation_rms_mm"]
    assert m["deviation_rms_mm"] < 0.1
    assert not ctx.warnings
    with pytest.raises(ValidationError, match="keep_boundary needs method: fast-simplification"):
        decimate.Config(keep_boundary=True, method="qslim")


def test_without_pymeshlab_the_message_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    with pytest.raises(ConfigError, match=r"PyMeshLab cannot be loaded .*libgl1 and libopengl0"):
        go(decimate, star_shape(3), n_faces=200, method="pymeshlab")

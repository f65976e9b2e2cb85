from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from ssmpipe.core.correspondence.newcomer import FixedCohort, bring_in
from ssmpipe.core.correspondence.open_rims import register_reference
from ssmpipe.core.correspondence.optimize import optimize_correspondence
from ssmpipe.core.correspondence.options import EngineOptions
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.evaluate import SplineStack
from tests.support.cut_shapes import CUTS, SURFACES, TUBE, cut_cohort

N = 21


@cache
def splines(kind):
    return cut_cohort(kind)


def options(kind, **changes):
    _, edges, boundary = SURFACES[kind]
    chosen = {
        "n_coefficients": (6, 6), "landmarks": (N, N), "pose": "keep", "normalize": "none", "reference": 0,
        "start": "affine", "boundary": boundary, "open_edges": edges,
    }  # fmt: skip
    return EngineOptions(**chosen | changes)


@cache
def result(kind, rims):
    return optimize_correspondence(splines(kind), options(kind, rims=rims)).value


def miss(kind, optimum):
    """Return the mean spread of corresponding places in the shared coordinates, along v [mm]."""
    low, high = CUTS[:, :1], CUTS[:, 1:]
    shared = low + (high - low) * optimum.parameters[..., 1]
    return float((40.0 * np.abs(shared - shared.mean(axis=0))).mean())


@pytest.mark.parametrize("kind", ["disk", "tube"])
def test_free_rims_find_what_kept_ones_cannot(kind) -> None:
    kept, free = result(kind, "kept"), result(kind, "free")
    assert miss(kind, free) < 0.35 * miss(kind, kept)
    assert all(c.verdict == "proved" for c in free.certificates)
    assert free.reference == -1
    assert kept.reference == 0
    assert free.lacking == ()
    assert kept.window is None


@pytest.mark.parametrize("kind", ["disk", "tube"])
def test_the_window_is_what_all_shapes_have(kind) -> None:
    """The shared part is 0.06 to 0.95; a window of the first shape, which spans 0 to 1, must lie just inside."""
    window = result(kind, "free").window
    axes = (0, 1) if kind == "disk" else (1,)
    for axis in axes:
        assert 0.05 < window.low[axis] < 0.11
        assert 0.89 < window.high[axis] < 0.955
    if kind == "tube":
        assert (window.low[0], window.high[0]) == (0.0, 1.0)


@pytest.mark.parametrize("kind", ["disk", "tube"])
def test_shifts_of_the_rims_are_measured(kind) -> None:
    """Kept rims: how far apart they lie is told all the same."""
    found = result(kind, "kept").rim_shifts
    true = np.abs(CUTS - CUTS[0]).mean(axis=1)
    assert found[0] == 0
    assert found[1:] == pytest.approx(true[1:], abs=0.04 if kind == "disk" else 0.01)  # sheets slide along themselves


def test_a_shape_that_lacks_more_than_may_be_cropped_is_named() -> None:
    few = optimize_correspondence(splines("tube"), options("tube", rims="free", max_crop=0.02, max_iterations=2)).value
    assert few.window.low[1] <= 0.02
    assert few.window.high[1] >= 0.98
    assert 1 in few.lacking
    assert 4 in few.lacking
    assert 2 not in few.lacking


@pytest.mark.parametrize("kind", ["disk", "tube"])
@pytest.mark.parametrize("normals", [0.0, 0.8])
def test_a_shape_of_the_cohort_comes_back_into_its_window(kind, normals) -> None:
    optimum = optimize_correspondence(splines(kind), options(kind, rims="free", normals=normals)).value
    chosen = options(kind, lambda_cut=optimum.lambda_cut, window=optimum.window)
    seen = {"normals": optimum.normals, "normal_scale": optimum.normal_scale}
    fixed = FixedCohort(optimum.points, (N, N), closes=kind == "tube", options=chosen, **seen)
    found = bring_in(splines(kind)[1], fixed).value
    assert found.certificate.verdict == "proved"
    apart = np.linalg.norm(found.points - optimum.points[1], axis=1).mean()
    before = np.linalg.norm(found.initial_points - optimum.points[1], axis=1).mean()
    assert apart < 0.01 * before


def test_places_beyond_a_rim_are_carried_past_it() -> None:
    few = [splines("tube")[2], splines("tube")[1]]  # the second one begins 0.11 later
    space = Reparameterization((6, 6), (N, N), boundary="periodic")
    found = register_reference(SplineStack(few, space.periodic), space, 0, TUBE, turns=np.zeros(2))
    at = found.carried(np.array([[0.3, 0.0]]))[1, 0, 1]
    true = (CUTS[2, 0] - CUTS[1, 0]) / (CUTS[1, 1] - CUTS[1, 0])
    assert at == pytest.approx(true, abs=0.02)


def test_maps_that_are_taken_back_keep_their_turn(monkeypatch) -> None:
    """The reference begins elsewhere than the first shape; every map that is taken back still goes towards its own turn."""
    monkeypatch.setattr("ssmpipe.core.correspondence.affine_start.LEAST_JACOBIAN", 0.9)  # as if nearly all had folds
    seams = np.array([0.0, 0.3, 0.3, 0.3, 0.3])
    chosen = options("tube", rims="free", reference=2, max_iterations=1)
    found = optimize_correspondence(cut_cohort("tube", seams), chosen).value
    around = found.parameters[..., 0] + seams[:, None]
    apart = (around - around[0] + 0.5) % 1 - 0.5
    assert np.abs(np.median(apart, axis=1)).max() < 0.005


@pytest.mark.parametrize("changes", [{"open_edges": ()}, {"coarse_to_fine": True}, {}])
def test_what_free_rims_cannot_do_is_refused(changes) -> None:
    guides = None if changes else [{"a": np.zeros(3)}] * 5
    with pytest.raises(GeometryError, match="rims: free"):
        optimize_correspondence(splines("tube"), options("tube", rims="free", **changes), guides=guides)

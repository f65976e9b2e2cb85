from __future__ import annotations

import numpy as np
import pytest

from ssmpipe.core.correspondence.optimize import optimize_correspondence
from ssmpipe.core.correspondence.options import EngineOptions
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.curve import BSplineCurve
from ssmpipe.core.spline.fit import fit_surface


def patch(shift: float, linear: np.ndarray) -> np.ndarray:
    """A hilly sheet in an affine frame of its own, whose parameters run ahead by ``shift`` in the middle; (41, 41, 3) samples."""
    u, v = np.meshgrid(np.linspace(0, 1, 41), np.linspace(0, 1, 41), indexing="ij")
    x, y = u + shift * np.sin(np.pi * u) * np.sin(np.pi * v), v - 0.5 * shift * np.sin(np.pi * u) * np.sin(np.pi * v)
    height = 0.3 * np.sin(2.5 * x + 1.0) * np.cos(3.5 * y) + 0.2 * np.exp(-20 * ((x - 0.4) ** 2 + (y - 0.6) ** 2))
    return 50.0 * np.stack([x, y, height], axis=-1) @ linear.T


def cohort():
    rng = np.random.default_rng(0)
    frames = [np.eye(3) + 0.15 * rng.normal(size=(3, 3)) for _ in range(5)]
    shifts = (0.0, 0.08, -0.06, 0.05, -0.09)
    return [fit_surface(patch(s, f), n_control=(20, 20)) for s, f in zip(shifts, frames, strict=True)], frames


def miss(points: np.ndarray, frames: list[np.ndarray]) -> float:
    """Mean distance of corresponding points in the common affine frame [mm]."""
    common = np.stack([p @ np.linalg.inv(f).T for p, f in zip(points, frames, strict=True)])
    return float(np.linalg.norm(common - common.mean(axis=0), axis=-1).mean())


@pytest.fixture(scope="module")
def results():
    splines, frames = cohort()
    options = {"landmarks": (21, 21), "n_coefficients": (6, 6), "pose": "keep", "reference": 0, "max_iterations": 1}
    starts = {
        s: optimize_correspondence(splines, EngineOptions(**options, start=s)).value for s in ("identity", "affine")
    }
    return {s: (miss(r.initial_points, frames), miss(r.points, frames), r) for s, r in starts.items()}


def test_affine_copies_start_in_correspondence(results) -> None:
    before, after, result = results["affine"]
    assert after < 0.25 * before
    assert after < 0.5 * results["identity"][1]
    assert all(c.verdict == "proved" for c in result.certificates)


def test_what_is_reported_as_before_is_the_identity(results) -> None:
    np.testing.assert_allclose(results["affine"][2].initial_points, results["identity"][2].initial_points, atol=1e-9)


def test_curves_are_refused() -> None:
    line = BSplineCurve(1, np.array([0, 0, 1, 1.0]), np.array([[0, 0], [1, 0.0]]))
    with pytest.raises(GeometryError, match="start: affine is for surfaces"):
        optimize_correspondence([line, line], EngineOptions(n_coefficients=(4,), landmarks=(9,), start="affine"))

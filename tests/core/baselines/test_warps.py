import numpy as np
import pytest
from scipy.integrate import quad

from ssmpipe.core.baselines.cauchy import LARGEST_LOG_DENSITY, CauchyWarp
from ssmpipe.core.baselines.clamped_plate import LARGEST_SHARE, ClampedPlateWarp, largest_displacement
from ssmpipe.core.errors import FoldoverError

LINE = np.linspace(0, 1, 4001)[:, None]
BOUNDS = (np.expm1(-LARGEST_LOG_DENSITY), np.expm1(LARGEST_LOG_DENSITY))


@pytest.mark.parametrize("magnitude", [*BOUNDS, -0.5, 2.0])
@pytest.mark.parametrize(("centre", "width"), [(0.0, 0.02), (0.31, 0.02), (0.5, 0.3), (1.0, 0.1)])
def test_cauchy_warps_are_bijections_that_keep_the_ends(magnitude, centre, width):
    warp = CauchyWarp(centre, width, magnitude)
    moved = warp(LINE)[:, 0]
    assert moved[0] == 0
    assert moved[-1] == pytest.approx(1, abs=1e-15)
    assert warp.derivative(LINE).min() > 0
    assert np.diff(moved).min() > 0


def test_a_cauchy_warp_of_no_magnitude_is_the_identity():
    np.testing.assert_array_equal(CauchyWarp(0.3, 0.1, 0.0)(LINE), LINE)


def test_a_cauchy_warp_is_the_integral_of_its_density():
    warp = CauchyWarp(0.3, 0.05, 4.0)

    def density(u):
        return 1 + 4.0 / (1 + ((u - 0.3) / 0.05) ** 2)

    total = quad(density, 0, 1, points=[0.3])[0]
    for u in (0.1, 0.29, 0.8):
        assert warp(np.array([[u]]))[0, 0] == pytest.approx(quad(density, 0, u, points=[0.3])[0] / total, abs=1e-9)
        assert warp.derivative(np.array([[u]]))[0, 0] == pytest.approx(density(u) / total, abs=1e-9)


@pytest.mark.parametrize("magnitude", [-1.0, -2.0, float("nan")])
def test_cauchy_warps_beyond_the_bound_are_refused(magnitude):
    with pytest.raises(FoldoverError, match="density negative"):
        CauchyWarp(0.5, 0.1, magnitude)


def square(n):
    return np.stack(np.meshgrid(*[np.linspace(0, 1, n)] * 2, indexing="ij"), axis=-1)


def disk(centre, width, n=401):
    t = np.linspace(0, 2 * np.pi, 73)
    r = np.linspace(0, width, n)
    return (np.asarray(centre) + np.stack([np.outer(r, np.cos(t)), np.outer(r, np.sin(t))], axis=-1)).reshape(-1, 2)


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.0, 4.0])
@pytest.mark.parametrize(("centre", "width"), [((0.5, 0.5), 0.5), ((0.2, 0.6), 0.2), ((0.85, 0.3), 0.03)])
def test_plate_warps_are_bijections_at_their_bound_and_keep_the_boundary(angle, centre, width):
    length = LARGEST_SHARE * largest_displacement(width)
    warp = ClampedPlateWarp(centre, width, (length * np.cos(angle), length * np.sin(angle)))
    assert warp.jacobian(disk(centre, width)).min() > 0
    edge = np.concatenate([square(101)[[0, -1]].reshape(-1, 2), square(101)[:, [0, -1]].reshape(-1, 2)])
    np.testing.assert_allclose(warp(edge), edge, atol=1e-15)
    grid = np.asarray(centre) + width * (2 * square(301) - 1)
    moved = warp(grid.reshape(-1, 2)).reshape(grid.shape)
    assert moved.min() >= 0
    assert moved.max() <= 1
    cells = np.stack([moved[1:, :-1] - moved[:-1, :-1], moved[:-1, 1:] - moved[:-1, :-1]], axis=-1)
    assert np.linalg.det(cells).min() > 0


def test_the_bound_of_plate_warps_is_sharp():
    """det - 1 is linear in the displacement and reaches minus its share of the bound."""
    centre, width = (0.5, 0.5), 0.4
    for share in (0.25, 0.5, 0.999):
        warp = ClampedPlateWarp(centre, width, (share * largest_displacement(width), 0.0))
        assert 1 - warp.jacobian(disk(centre, width)).min() == pytest.approx(share, rel=1e-5)


def test_jacobian_of_plate_warps_by_differences():
    warp = ClampedPlateWarp((0.4, 0.5), 0.35, (0.1, -0.15))
    points, h = np.random.default_rng(0).uniform(0.02, 0.98, (200, 2)), 1e-6
    slopes = [(warp(points + h * e) - warp(points - h * e)) / (2 * h) for e in np.eye(2)]
    np.testing.assert_allclose(warp.jacobian(points), np.linalg.det(np.stack(slopes, axis=-1)), atol=1e-6)


def test_a_plate_warp_of_no_magnitude_is_the_identity():
    points = square(21).reshape(-1, 2)
    np.testing.assert_array_equal(ClampedPlateWarp((0.5, 0.5), 0.5, (0.0, 0.0))(points), points)


def test_plate_warps_beyond_their_bounds_are_refused():
    bound = largest_displacement(0.2)
    with pytest.raises(FoldoverError, match="folds when displaced by"):
        ClampedPlateWarp((0.5, 0.5), 0.2, (0.0, bound))
    with pytest.raises(FoldoverError, match="leaves the unit square"):
        ClampedPlateWarp((0.1, 0.5), 0.2, (0.0, 0.01))

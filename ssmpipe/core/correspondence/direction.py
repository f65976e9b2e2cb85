"""One parameter direction of a reparameterization: a clamped or a periodic B-spline space on the unit interval."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.basis import design_matrix, gauss_rule, periodic_design_matrix
from ssmpipe.core.spline.knots import clamped_uniform_knots, greville


class Direction:
    """B-spline basis of the displacement ``D - id`` in one direction, with equal spans.

    Parameters
    ----------
    n_coefficients : int
    degree : int
    periodic : bool, default=False
        The basis closes over the ends, so that ``D(u + 1) = D(u) + 1``.

    Raises
    ------
    GeometryError
        If there are too few coefficients for the degree.

    Attributes
    ----------
    breakpoints : (n_spans + 1,) float64
    identity : (n_coefficients,) float64
        Abscissae of the identity map.

    Examples
    --------
    >>> Direction(4, 2).identity
    array([0.  , 0.25, 0.75, 1.  ])
    >>> bool(np.allclose(Direction(5, 2, periodic=True).matrix(np.array([0.0])), Direction(5, 2, periodic=True).matrix(np.array([1.0]))))
    True
    """

    def __init__(self, n_coefficients: int, degree: int, periodic: bool = False) -> None:
        self.degree = degree
        self.periodic = periodic
        self.n_coefficients = n_coefficients
        if periodic:
            if n_coefficients < degree + 1:
                raise GeometryError(
                    f"a periodic spline of degree {degree} needs at least {degree + 1} coefficients, got {n_coefficients}"
                )
            self.breakpoints = np.linspace(0.0, 1.0, n_coefficients + 1)
            self.identity = (np.arange(n_coefficients) - 0.5 * (degree - 1)) / n_coefficients
        else:
            self._knots = clamped_uniform_knots(n_coefficients, degree)
            self.breakpoints = np.linspace(0.0, 1.0, n_coefficients - degree + 1)
            self.identity = greville(self._knots, degree)

    @property
    def n_spans(self) -> int:
        """Number of polynomial pieces."""
        return len(self.breakpoints) - 1

    def matrix(self, nodes: Floats, derivative: int = 0) -> Floats:
        """Return the (n, n_coefficients) basis, or its derivatives, at ``nodes`` in [0, 1]."""
        if self.periodic:
            return periodic_design_matrix(nodes, self.n_coefficients, self.degree, derivative)
        return design_matrix(nodes, self._knots, self.degree, derivative)

    def gauss_rule(self, n_per_span: int) -> tuple[Floats, Floats]:
        """Return Gauss-Legendre nodes and weights on every span; the weights sum to 1."""
        return gauss_rule(self.breakpoints, n_per_span)

    def refinement(self, finer: Direction) -> Floats:
        """Return the matrix that maps coefficients of this space to those of a finer one that contains it.

        Raises
        ------
        GeometryError
            If the spans of ``finer`` do not nest in the spans of this space.
        """
        same = finer.degree == self.degree and finer.periodic == self.periodic
        if not same or finer.n_spans % self.n_spans:
            raise GeometryError(
                f"{finer.n_spans} spans of degree {finer.degree} do not nest in {self.n_spans} of degree {self.degree}"
            )
        nodes, _ = finer.gauss_rule(self.degree + 1)
        return np.asarray(np.linalg.lstsq(finer.matrix(nodes), self.matrix(nodes), rcond=None)[0])


def apply_directions(matrices: tuple[Floats, ...], field: Floats, out: Floats | None = None) -> Floats:
    """Apply one matrix per direction to the last axes of ``field``, into the memory of ``out`` where given."""
    if len(matrices) == 1:
        return np.matmul(field, matrices[0].T, out=out)
    return np.matmul(matrices[0] @ field, matrices[1].T, out=out)


def components_first(field: Floats) -> Floats:
    """Return (n, *grid, d) as a view (n, d, *grid)."""
    return field.transpose(0, field.ndim - 1, *range(1, field.ndim - 1))


def components_last(field: Floats) -> Floats:
    """Return (n, d, *grid) as a view (n, *grid, d)."""
    return field.transpose(0, *range(2, field.ndim), 1)

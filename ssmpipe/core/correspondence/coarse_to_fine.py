"""Nested spaces of maps: those that are solved first, and the same maps in a finer one."""

from __future__ import annotations

from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.direction import apply_directions, components_first, components_last
from ssmpipe.core.correspondence.reparameterization import Reparameterization


def coarser_spaces(space: Reparameterization) -> list[tuple[int, ...]]:
    """Return the numbers of coefficients of the coarser nested spaces, coarsest first: spans halved while they can be and two are left.

    Examples
    --------
    >>> coarser_spaces(Reparameterization((10, 10), (3, 3)))
    [(4, 4), (6, 6)]
    """
    levels: list[tuple[int, ...]] = []
    spans = [d.n_spans for d in space.directions]
    while all(s % 2 == 0 and s >= 4 for s in spans):
        spans = [s // 2 for s in spans]
        extra = [0 if p else space.degree for p in space.periodic]
        levels.append(tuple(s + e for s, e in zip(spans, extra, strict=True)))
    return levels[::-1]


def refined(coefficients: Floats, coarse: Reparameterization, fine: Reparameterization) -> Floats:
    """Return the same maps in the finer space, by knot insertion: (n_S, *n_b, d_par) coefficients to those of ``fine``.

    Raises
    ------
    GeometryError
        If the spaces do not nest.
    """
    matrices = tuple(c.refinement(f) for c, f in zip(coarse.directions, fine.directions, strict=True))
    displacement = components_first(coefficients - coarse.identity())
    return fine.identity() + components_last(apply_directions(matrices, displacement))

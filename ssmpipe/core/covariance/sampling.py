"""Points and derivatives of ``S_i(D_i(u))`` for any splines ``S_i`` and spline reparameterizations ``D_i``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.spline.evaluate import Jet, Spline, SplineStack


def sample(splines: Sequence[Spline], parameters: Floats, maps: Sequence[Spline] | None = None) -> Jet:
    """Return positions and first derivatives with respect to ``u`` of ``S_i(D_i(u))``.

    Parameters
    ----------
    splines : sequence of BSplineCurve or BSplineSurface
        ``n_S`` of equal degree and knots.
    parameters : (n_P, d_par) float64
    maps : sequence of splines, optional
        One per shape, of dimension ``d_par``, equal degree and knots; the identity if absent.

    Returns
    -------
    Jet
        ``points`` (n_S, n_P, d), ``first`` by the chain rule.

    Raises
    ------
    GeometryError
        If the numbers of shapes or dimensions do not match.
    """
    repeated = np.repeat(parameters[None], len(splines), axis=0)
    stack = SplineStack(splines)
    if maps is None:
        return stack.evaluate(repeated)
    if len(maps) != len(splines) or maps[0].dimension != stack.n_directions:
        raise GeometryError(
            f"{len(maps)} reparameterizations of dimension {maps[0].dimension} do not fit "
            f"{len(splines)} shapes with {stack.n_directions} parameters"
        )
    inner = SplineStack(maps).evaluate(repeated)
    outer = stack.evaluate(np.clip(inner.points, 0.0, 1.0))
    first = tuple(
        sum((outer.first[b] * inner_slope[..., b : b + 1] for b in range(stack.n_directions)), np.zeros(()))
        for inner_slope in inner.first
    )
    return Jet(outer.points, first)

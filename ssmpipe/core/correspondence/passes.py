"""Passes over the landmarks of all shapes that touch memory once: plain numpy, or compiled with the same bits.

Sums run over the shapes, or over the components of a point, one after the other in both.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.spline import compiled
from ssmpipe.core.spline.evaluate import Evaluator


def centre_and_scale(
    points: Floats, root: Floats, centred: Floats, block: slice, evaluator: Evaluator = "numpy"
) -> Floats:
    """Write some landmarks minus their mean over the shapes to ``centred``; return them scaled, a row per shape.

    Parameters
    ----------
    points : (n_S, n_P, d)
    root : (n_P,)
        Factor of every landmark.
    centred : (n_S, n_P, d)
        Is overwritten in ``block``.
    block : slice
        n landmarks.
    evaluator : {"numpy", "numba"}

    Returns
    -------
    (n_S, n d)

    Examples
    --------
    >>> points = np.array([[[1.0], [2.0]], [[3.0], [2.0]]])
    >>> centre_and_scale(points, np.array([2.0, 1.0]), np.empty_like(points), slice(0, 2))
    array([[-2.,  0.],
           [ 2.,  0.]])
    """
    if evaluator == "numba":
        scaled = np.empty((len(points), (block.stop - block.start) * points.shape[2]))
        _compiled("centre")(points, root, centred, block.start, block.stop, scaled)
        return scaled
    part = points[:, block]
    np.subtract(part, np.add.reduce(part, axis=0) / len(points), out=centred[:, block])
    return np.asarray((centred[:, block] * root[block, None]).reshape(len(points), -1))


def contract(
    forces: Floats,
    weights: Floats,
    tangents: tuple[Floats, ...],
    out: Floats,
    block: slice,
    evaluator: Evaluator = "numpy",
) -> None:
    """Write ``weight_l force_il . tangent_il`` of some landmarks for every tangent.

    Parameters
    ----------
    forces : (n_S, n d)
        Of the n landmarks of ``block``.
    weights : (n_P,)
    tangents : d_par arrays of (n_S, n_P, d)
    out : (n_S, d_par, n_P)
        Is overwritten in ``block``.
    block : slice
    evaluator : {"numpy", "numba"}

    Examples
    --------
    >>> out = np.empty((1, 1, 2))
    >>> contract(np.ones((1, 6)), np.array([1.0, 10.0]), (np.ones((1, 2, 3)),), out, slice(0, 2))
    >>> out
    array([[[ 3., 30.]]])
    """
    forces = forces.reshape(len(forces), -1, tangents[0].shape[2])
    for c, tangent in enumerate(tangents):
        if evaluator == "numba":
            _compiled("contract")(forces, weights, tangent, out, c, block.start, block.stop)
            continue
        part = tangent[:, block]
        total = forces[..., 0] * part[..., 0]
        for k in range(1, forces.shape[-1]):
            total += forces[..., k] * part[..., k]
        np.multiply(total, weights[block], out=out[:, c, block])


# whole arrays and a range, not slices: the compiler then knows that memory is contiguous


def _centre(points: Floats, root: Floats, centred: Floats, start: int, stop: int, scaled: Floats) -> None:
    n, _, d = points.shape
    mean = np.zeros((stop - start, d))
    factor = np.empty((stop - start, d))
    for j in range(start, stop):
        for k in range(d):
            mean[j - start, k] = points[0, j, k]
            factor[j - start, k] = root[j]
    means, factors = mean.reshape(-1), factor.reshape(-1)
    every, kept = points.reshape(n, -1), centred.reshape(n, -1)
    for i in range(1, n):
        row = every[i, start * d : stop * d]
        for j in range(len(means)):
            means[j] += row[j]
    for j in range(len(means)):
        means[j] /= n
    for i in range(n):
        row = every[i, start * d : stop * d]
        target = kept[i, start * d : stop * d]
        for j in range(len(means)):
            value = row[j] - means[j]
            target[j] = value
            scaled[i, j] = value * factors[j]


def _contract(forces: Floats, weights: Floats, tangent: Floats, out: Floats, c: int, start: int, stop: int) -> None:
    n, _, d = forces.shape
    if d == 3:  # the same sums, twice as fast
        for i in range(n):
            for j in range(start, stop):
                f, t = forces[i, j - start], tangent[i, j]
                out[i, c, j] = (f[0] * t[0] + f[1] * t[1] + f[2] * t[2]) * weights[j]
        return
    for i in range(n):
        for j in range(start, stop):
            total = forces[i, j - start, 0] * tangent[i, j, 0]
            for k in range(1, d):
                total += forces[i, j - start, k] * tangent[i, j, k]
            out[i, c, j] = total * weights[j]


_PASSES: dict[str, Callable[..., None]] = {"centre": _centre, "contract": _contract}


@cache
def _compiled(name: str) -> Callable[..., Any]:
    return compiled.build(_PASSES[name])

"""Compiled evaluation of local polynomials; needs the extra ``fast`` (numba), imported on first use only.

The kernel does the operations of the numpy path in the same order and without fused multiply-adds, so both give the
same bits. It holds no lock, so that threads may evaluate different shapes at the same time.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from typing import Any

import numpy as np

from ssmpipe.core.arrays import Floats, Ints


def available() -> bool:
    """Return whether numba is installed; does not import it.

    Examples
    --------
    >>> available() in (True, False)
    True
    """
    return find_spec("numba") is not None


def _locate(parameters: Floats, n_spans: int, periodic: bool, index: Ints, local: Floats) -> None:
    """Write span index and local coordinate of (n, n_P) parameters in equal spans of the unit interval."""
    for i in range(parameters.shape[0]):
        for l in range(parameters.shape[1]):
            x = parameters[i, l]
            if periodic:
                x = x - np.floor(x)
            scaled = x * n_spans
            cell = int(scaled)
            if cell < 0:
                cell = 0
            elif cell > n_spans - 1:
                cell = n_spans - 1
            index[i, l] = cell
            local[i, l] = scaled - cell


def _curves(blocks: Floats, index: Ints, t: Floats, du: Floats, point: Floats, first: Floats) -> None:
    """Evaluate (n, n_cells, p + 1, d) polynomials and their derivative at (n, n_P) places of n curves."""
    degree = blocks.shape[2] - 1
    for i in range(index.shape[0]):
        for l in range(index.shape[1]):
            cell = index[i, l]
            x = t[i, l]
            for c in range(blocks.shape[3]):
                value = blocks[i, cell, degree, c]
                slope = 0.0
                for k in range(degree - 1, -1, -1):
                    slope = slope * x + value
                    value = value * x + blocks[i, cell, k, c]
                point[i, l, c] = value
                first[i, l, c] = slope * du[i, l]


def _curves_second(
    blocks: Floats, index: Ints, t: Floats, du: Floats, point: Floats, first: Floats, second: Floats
) -> None:
    """As :func:`_curves`, with the second derivative."""
    degree = blocks.shape[2] - 1
    for i in range(index.shape[0]):
        for l in range(index.shape[1]):
            cell = index[i, l]
            x = t[i, l]
            scale = du[i, l]
            for c in range(blocks.shape[3]):
                value = blocks[i, cell, degree, c]
                slope = 0.0
                bend = 0.0
                for k in range(degree - 1, -1, -1):
                    bend = bend * x + 2 * slope
                    slope = slope * x + value
                    value = value * x + blocks[i, cell, k, c]
                point[i, l, c] = value
                first[i, l, c] = slope * scale
                second[i, l, c] = bend * (scale * scale)


def _surfaces(
    blocks: Floats,
    n_v: int,
    index_u: Ints,
    t: Floats,
    du: Floats,
    index_v: Ints,
    s: Floats,
    dv: Floats,
    point: Floats,
    along_u: Floats,
    along_v: Floats,
) -> None:
    """Evaluate (n, n_cells, p + 1, q + 1, d) polynomials and both first derivatives at (n, n_P) places of n surfaces."""
    n, n_cells = blocks.shape[:2]
    degree_u = blocks.shape[2] - 1
    degree_v = blocks.shape[3] - 1
    d = blocks.shape[4]
    m = (degree_v + 1) * d
    flat = blocks.reshape(n, n_cells, degree_u + 1, m)
    value = np.empty(m)
    slope = np.empty(m)
    for i in range(n):
        for l in range(index_u.shape[1]):
            local = flat[i, index_u[i, l] * n_v + index_v[i, l]]
            x = t[i, l]
            y = s[i, l]
            for c in range(m):
                value[c] = local[degree_u, c]
                slope[c] = 0.0
            for k in range(degree_u - 1, -1, -1):
                for c in range(m):
                    slope[c] = slope[c] * x + value[c]
                    value[c] = value[c] * x + local[k, c]
            for c in range(d):
                here = value[degree_v * d + c]
                in_u = slope[degree_v * d + c]
                in_v = 0.0
                for k in range(degree_v - 1, -1, -1):
                    in_v = in_v * y + here
                    here = here * y + value[k * d + c]
                    in_u = in_u * y + slope[k * d + c]
                point[i, l, c] = here
                along_u[i, l, c] = in_u * du[i, l]
                along_v[i, l, c] = in_v * dv[i, l]


def _surfaces_second(
    blocks: Floats,
    n_v: int,
    index_u: Ints,
    t: Floats,
    du: Floats,
    index_v: Ints,
    s: Floats,
    dv: Floats,
    point: Floats,
    along_u: Floats,
    along_v: Floats,
    uu: Floats,
    uv: Floats,
    vv: Floats,
) -> None:
    """As :func:`_surfaces`, with the second derivatives."""
    n, n_cells = blocks.shape[:2]
    degree_u = blocks.shape[2] - 1
    degree_v = blocks.shape[3] - 1
    d = blocks.shape[4]
    m = (degree_v + 1) * d
    flat = blocks.reshape(n, n_cells, degree_u + 1, m)
    value = np.empty(m)
    slope = np.empty(m)
    bend = np.empty(m)
    for i in range(n):
        for l in range(index_u.shape[1]):
            local = flat[i, index_u[i, l] * n_v + index_v[i, l]]
            x = t[i, l]
            y = s[i, l]
            for c in range(m):
                value[c] = local[degree_u, c]
                slope[c] = 0.0
                bend[c] = 0.0
            for k in range(degree_u - 1, -1, -1):
                for c in range(m):
                    bend[c] = bend[c] * x + 2 * slope[c]
                    slope[c] = slope[c] * x + value[c]
                    value[c] = value[c] * x + local[k, c]
            for c in range(d):
                here = value[degree_v * d + c]
                in_u = slope[degree_v * d + c]
                in_uu = bend[degree_v * d + c]
                in_v = 0.0
                in_vv = 0.0
                in_uv = 0.0
                for k in range(degree_v - 1, -1, -1):
                    in_vv = in_vv * y + 2 * in_v
                    in_v = in_v * y + here
                    here = here * y + value[k * d + c]
                    in_uv = in_uv * y + in_u
                    in_u = in_u * y + slope[k * d + c]
                    in_uu = in_uu * y + bend[k * d + c]
                point[i, l, c] = here
                along_u[i, l, c] = in_u * du[i, l]
                along_v[i, l, c] = in_v * dv[i, l]
                uu[i, l, c] = in_uu * (du[i, l] * du[i, l])
                uv[i, l, c] = in_uv * (du[i, l] * dv[i, l])
                vv[i, l, c] = in_vv * (dv[i, l] * dv[i, l])


@cache
def kernel(n_directions: int, second: bool) -> Callable[..., Any]:
    """Return a compiled kernel; compiled once per machine where numba finds a place for its cache."""
    return build(((_curves, _curves_second), (_surfaces, _surfaces_second))[n_directions - 1][second])


@cache
def locator() -> Callable[..., Any]:
    """Return the compiled search for spans."""
    return build(_locate)


def build(function: Callable[..., None]) -> Callable[..., Any]:
    """Return ``function`` compiled without lock and without reordered or fused operations."""
    import numba

    try:
        compiled: Callable[..., Any] = numba.njit(function, nogil=True, cache=True)
    except RuntimeError:  # no folder for the cache
        compiled = numba.njit(function, nogil=True)
    return compiled

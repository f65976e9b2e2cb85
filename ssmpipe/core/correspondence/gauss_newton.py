"""The Gauss-Newton matrix of the group objective, inverted: factored while it is small, else by conjugate gradients.

Block ``(i, j)`` is ``c_ij T_i^T W T_j``, plus on the diagonal what each shape has of its own (barrier, prior, guides). ``T_i`` takes
coefficients to movements of landmarks, ``W`` holds the landmark weights, and ``c`` couples the shapes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf as potrf
from scipy.linalg.lapack import dpotrs as potrs

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.blocks import map_blocks
from ssmpipe.core.correspondence.reparameterization import Reparameterization

Singles: TypeAlias = NDArray[np.float32]

FACTORED_UNKNOWNS = 1500
"""Up to so many unknowns a Cholesky factor is cheaper than the iteration; its cost grows with the cube."""
_NODES_PER_SPAN = 3
_RESIDUAL = 0.2
_MOST_PRODUCTS = 60
SHAPES_PER_BLOCK = 4
"""Blocks of unknowns: their intermediate results are larger than the landmarks."""
_PAIRS_PER_BLOCK = 8


def gauss_newton_inverse(
    space: Reparameterization,
    coupling: Floats,
    weights: Floats,
    tangents: tuple[Floats, ...],
    own: Floats,
    threads: int = 1,
    moving: Ints | None = None,
) -> Callable[[Floats], Floats]:
    """Return the product of the inverse with a vector.

    Parameters
    ----------
    space : Reparameterization
        Its nodes are the ``n_P`` landmarks, its free coefficients the ``n`` unknowns of a shape.
    coupling : (m, m)
        ``c``, positive semidefinite.
    weights : (n_P,)
    tangents : d_par arrays of (n_S, n_P, d)
        ``S_u, S_v``.
    own : (m, n, n)
        Blocks of the shapes themselves, positive semidefinite.
    threads : int, default=1
    moving : (m,) int, optional
        Which shapes the ``m`` are; all by default.

    Returns
    -------
    callable
        (m * n,) to (m * n,). Beyond ``FACTORED_UNKNOWNS`` it is approximate, but the same for the same input.
    """
    invert = _by_factor if own.shape[0] * own.shape[1] <= FACTORED_UNKNOWNS else _by_iteration
    return invert(space, coupling, weights, tangents, own, threads, np.arange(len(own)) if moving is None else moving)


def _metric(first: tuple[Floats, ...], second: tuple[Floats, ...]) -> Floats:
    """Return ``T_i^T T_j`` at every landmark, (..., n_P, d_par, d_par)."""
    rows = [np.stack([np.einsum("...d,...d->...", a, b) for b in second], axis=-1) for a in first]
    return np.stack(rows, axis=-2)


def _shifted(blocks: Floats) -> Floats:
    """Return the blocks, now with a trace of the unit matrix, so that they can be factored."""
    n = blocks.shape[-1]
    every = np.arange(n)
    blocks[..., every, every] += (1e-8 / n * np.trace(blocks, axis1=-2, axis2=-1))[..., None]
    return blocks


def _by_factor(
    space: Reparameterization,
    coupling: Floats,
    weights: Floats,
    tangents: tuple[Floats, ...],
    own: Floats,
    threads: int,
    moving: Ints,
) -> Callable[[Floats], Floats]:
    """Assemble all blocks and factor them."""
    m, n = own.shape[:2]
    whole = np.empty((m, n, m, n))

    def data(first: Ints, second: Ints) -> Floats:
        metric = _metric(tuple(t[moving[first]] for t in tangents), tuple(t[moving[second]] for t in tangents))
        metric *= (coupling[first, second][:, None] * weights)[..., None, None]
        return space.normal_blocks(metric)

    rows, columns = np.triu_indices(m, 1)

    def coupled(part: slice) -> None:
        blocks = data(rows[part], columns[part])
        for i, j, block in zip(rows[part], columns[part], blocks, strict=True):
            whole[i, :, j] = block  # the other half is not read

    def diagonal(part: slice) -> None:
        every = np.arange(m)[part]
        blocks = data(every, every)
        blocks += own[part]
        for i, block in zip(every, _shifted(blocks), strict=True):
            whole[i, :, i] = block

    map_blocks(coupled, len(rows), _PAIRS_PER_BLOCK, threads)
    map_blocks(diagonal, m, SHAPES_PER_BLOCK, threads)
    # the transpose is what LAPACK's order of memory makes of it: no copy; its lower half is our upper one
    factor, failed = potrf(whole.reshape(m * n, m * n).T, lower=1, clean=0, overwrite_a=1)
    if failed:
        raise np.linalg.LinAlgError(f"the Gauss-Newton matrix of {m * n} unknowns is not positive definite")
    return lambda vector: np.asarray(potrs(factor, vector, lower=1)[0])


@lru_cache(maxsize=4)
def _coarsened(space: Reparameterization) -> tuple[Ints, Reparameterization, list[Ints], list[Singles]]:
    """Return every k-th landmark, the maps there, and per component of ``D`` its unknowns and their basis."""
    n_d = space.n_directions
    free = np.flatnonzero(space.free.ravel())
    strides = [
        max(1, len(u) // (_NODES_PER_SPAN * d.n_spans)) for u, d in zip(space.nodes, space.directions, strict=True)
    ]
    kept = np.arange(math.prod(space.grid)).reshape(space.grid)[tuple(slice(None, None, s) for s in strides)].ravel()
    coarse = space.at(tuple(u[::s] for u, s in zip(space.nodes, strides, strict=True)))
    components = [np.flatnonzero(free % n_d == c) for c in range(n_d)]
    basis = coarse.rows_at(coarse.evaluate(coarse.identity()[None])[0])
    return kept, coarse, components, [basis[:, free[c] // n_d].astype(np.float32) for c in components]


def _by_iteration(
    space: Reparameterization,
    coupling: Floats,
    weights: Floats,
    tangents: tuple[Floats, ...],
    own: Floats,
    threads: int,
    moving: Ints,
) -> Callable[[Floats], Floats]:
    """Apply the matrix instead of assembling it, on every k-th landmark and in single precision, which is precise enough here.

    The iteration is preconditioned as if all shapes had the same tangents and the same own block: the eigenvectors of ``c`` then
    part the matrix into one block per mode.
    """
    m, n = own.shape[:2]
    kept, coarse, components, bases = _coarsened(space)
    weights = weights[kept] * (weights.sum() / weights[kept].sum())
    tangents = tuple(t[moving[:, None], kept] for t in tangents)

    metric = _metric(tangents, tangents)
    mean_data = coarse.normal_blocks(metric.mean(axis=0) * weights[:, None, None])
    strength, modes = np.linalg.eigh(coupling)
    strength = np.maximum(strength, 1e-12 * strength[-1])
    mean_own = own.mean(axis=0)

    def inverse(part: slice) -> Singles:
        whole = _shifted(strength[part, None, None] * mean_data + mean_own)
        return np.asarray(np.linalg.inv(whole), dtype=np.float32)

    inverses = np.concatenate(map_blocks(inverse, m, SHAPES_PER_BLOCK, threads))
    modes = modes.astype(np.float32)

    moves = [(np.ascontiguousarray(np.swapaxes(t, 1, 2)) * np.sqrt(weights)).astype(np.float32) for t in tangents]
    diagonal = np.trace(own, axis1=1, axis2=2) + np.diagonal(coupling) * np.trace(mean_data)
    blocks = own.astype(np.float32)
    every = np.arange(n)
    blocks[:, every, every] += (1e-8 / n * diagonal)[:, None].astype(np.float32)
    pull = coupling.astype(np.float32)

    def separate(residual: Singles) -> Singles:
        return np.asarray(modes @ (inverses @ (modes.T @ residual)[..., None])[..., 0])

    def product(vector: Singles) -> Singles:
        parts = zip(moves, components, bases, strict=True)
        moved = sum(t * (vector[:, c] @ b.T)[:, None] for t, c, b in parts)
        force = (pull @ np.reshape(moved, (m, -1))).reshape(np.shape(moved))
        out = (blocks @ vector[..., None])[..., 0]
        for t, c, b in zip(moves, components, bases, strict=True):
            out[:, c] += (t * force).sum(axis=1) @ b
        return np.asarray(out)

    def solve(vector: Floats) -> Floats:
        scale = float(np.linalg.norm(vector))
        if scale == 0.0:
            return vector
        residual: Singles = (vector / scale).astype(np.float32).reshape(m, n)
        solution = np.zeros_like(residual)
        search = z = separate(residual)
        product_rz = start = float(np.vdot(residual, z))
        for _ in range(_MOST_PRODUCTS):
            curved = product(search)
            curvature = float(np.vdot(search, curved))
            if curvature <= 0.0:
                break
            step = np.float32(product_rz / curvature)
            solution += step * search
            residual = residual - step * curved
            z = separate(residual)
            previous, product_rz = product_rz, float(np.vdot(residual, z))
            if product_rz <= _RESIDUAL**2 * start:
                break
            search = z + np.float32(product_rz / previous) * search
        return np.asarray(scale * solution.ravel(), dtype=np.float64)

    return solve

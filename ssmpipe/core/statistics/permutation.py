"""Which rows may change places under the null hypothesis, and random draws of it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from math import factorial, prod

import numpy as np

from ssmpipe.core.arrays import Floats, Ints


@dataclass(frozen=True, eq=False)
class Draws:
    """Random rearrangements of the rows of a sample: exchanged, or with their signs flipped.

    Parameters
    ----------
    rows : (n_draws, n) int64, optional
        Row ``rows[b, i]`` of the sample takes place ``i``.
    signs : (n_draws, n) float64, optional
        Factor of every row, +1 or -1.
    """

    rows: Ints | None = None
    signs: Floats | None = None

    def __len__(self) -> int:
        return len(self._given())

    def _given(self) -> Ints | Floats:
        given = self.rows if self.rows is not None else self.signs
        if given is None:
            raise ValueError("draws need rows or signs")
        return given

    def moved(self, matrix: Floats, start: int, stop: int) -> Floats:
        """Return ``matrix`` (n, k) rearranged by the draws from ``start`` to ``stop``, (stop - start, n, k)."""
        if self.rows is not None:
            return matrix[self.rows[start:stop]]
        return np.asarray(self._given()[start:stop, :, None] * matrix)


def exchanges(blocks: Ints, n_draws: int, rng: np.random.Generator) -> Draws:
    """Draw rearrangements that keep the rows of one subject together.

    Subjects with the same number of rows change places as a whole, and the rows of a subject change places among themselves:
    these are the exchanges that leave the joint distribution as it is when shapes of one subject are alike (Winkler et al. 2015,
    whole-block and within-block exchangeability). Subjects with different numbers of rows never change places, so the level
    of the test holds whatever the correlation inside of a subject.

    Parameters
    ----------
    blocks : (n,) int64
        Number of the subject of every row.
    n_draws : int
    rng : numpy.random.Generator

    Examples
    --------
    >>> draws = exchanges(np.array([0, 0, 1, 1]), 200, np.random.default_rng(0))
    >>> sorted({tuple(int(x) for x in np.array([5, 5, 7, 7])[row]) for row in draws.rows})
    [(5, 5, 7, 7), (7, 7, 5, 5)]
    """
    rows = np.empty((n_draws, len(blocks)), dtype=np.int64)
    for members in _strata(blocks):
        n_blocks, size = members.shape
        order = rng.permuted(np.tile(np.arange(n_blocks), (n_draws, 1)), axis=1)
        inside = rng.permuted(np.tile(np.arange(size), (n_draws * n_blocks, 1)), axis=1)
        source = members[order[:, :, None], inside.reshape(n_draws, n_blocks, size)]
        rows[:, members.ravel()] = source.reshape(n_draws, -1)
    return Draws(rows=rows)


def sign_flips(n: int, n_draws: int, rng: np.random.Generator) -> Draws:
    """Draw random signs for ``n`` differences that are symmetric about zero under the null hypothesis."""
    return Draws(signs=rng.choice(np.array([-1.0, 1.0]), size=(n_draws, n)))


def n_exchanges(labels: Ints, blocks: Ints) -> int:
    """Return how many different labellings the exchanges can reach.

    Examples
    --------
    >>> n_exchanges(np.array([0, 0, 0, 1, 1, 1]), np.arange(6))
    20
    >>> n_exchanges(np.array([0, 1, 0, 1]), np.array([0, 0, 1, 1]))
    4
    """
    total = 1
    for members in _strata(blocks):
        patterns = Counter(tuple(sorted(labels[block].tolist())) for block in members)
        total *= factorial(len(members)) // prod(factorial(count) for count in patterns.values())
        for pattern, count in patterns.items():
            inside = factorial(len(pattern)) // prod(factorial(k) for k in Counter(pattern).values())
            total *= inside**count
    return total


def permutation_p(observed: Floats, n_as_large: Ints, n_draws: int) -> Floats:
    """Return p values that count the observed arrangement as one of the draws (Phipson and Smyth 2010).

    Examples
    --------
    >>> permutation_p(np.array([2.0]), np.array([4]), 99)
    array([0.05])
    """
    return np.where(np.isfinite(observed), (1.0 + n_as_large) / (1.0 + n_draws), np.nan)


def _strata(blocks: Ints) -> list[Ints]:
    """Return the row numbers of the blocks of each size, (n_blocks, size) each."""
    _, block, sizes = np.unique(blocks, return_inverse=True, return_counts=True)
    order = np.argsort(block, kind="stable")
    members = np.split(order, np.cumsum(sizes)[:-1])
    return [np.stack([m for m in members if len(m) == size]) for size in np.unique(sizes)]

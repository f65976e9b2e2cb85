"""Differences inside of subjects: left against right, before against after."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmpipe.core.arrays import Floats, Ints


@dataclass(frozen=True, eq=False)
class Pairs:
    """Subjects with shapes in both groups.

    Parameters
    ----------
    subjects : (n_pairs,) int64
        Number of the subject of each pair.
    weights : (n_pairs, n) float64
        Rows: mean of the subject's shapes in the second group less mean of those in the first.
    left_out : (n_left_out,) int64
        Subjects with shapes in one group only.
    """

    subjects: Ints
    weights: Floats
    left_out: Ints

    def differences(self, values: Floats) -> Floats:
        """Return second less first for ``values`` (n, ...), (n_pairs, ...)."""
        return np.tensordot(self.weights, values, axes=1)


def pairs(labels: Ints, subjects: Ints) -> Pairs:
    """Find the subjects with shapes in both groups.

    Parameters
    ----------
    labels : (n,) int64
        0 or 1.
    subjects : (n,) int64

    Examples
    --------
    >>> found = pairs(np.array([0, 1, 0, 1, 1]), np.array([7, 7, 8, 9, 9]))
    >>> found.subjects, found.left_out, found.differences(np.array([1.0, 4.0, 0, 0, 0]))
    (array([7]), array([8, 9]), array([3.]))
    """
    numbers = np.unique(subjects)
    own = subjects[None, :] == numbers[:, None]
    first, second = own & (labels == 0), own & (labels == 1)
    both = first.any(axis=1) & second.any(axis=1)
    weights = second[both] / second[both].sum(axis=1, keepdims=True) - first[both] / first[both].sum(
        axis=1, keepdims=True
    )
    return Pairs(numbers[both], weights, numbers[~both])

"""The most central shape of a cohort, before anything is aligned."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial.distance import pdist

from ssmpipe.core.arrays import Floats
from ssmpipe.core.mesh.distance import sample_surface
from ssmpipe.core.mesh.trimesh import TriMesh

TIE = 1e-9
"""Sums that differ by no more than this share are equal [-]."""


def distance_quantiles(mesh: TriMesh, n_points: int = 1000, n_quantiles: int = 200) -> Floats:
    """Return quantiles of the distances between all pairs of points spread over a surface, (n_quantiles,) [mm].

    The "D2" shape distribution (Osada et al. 2002): unchanged by rigid motions and reflections.
    """
    distances = pdist(sample_surface(mesh, n_points)[0])
    return np.asarray(np.quantile(distances, (np.arange(n_quantiles) + 0.5) / n_quantiles))


def distribution_distances(meshes: Mapping[str, TriMesh]) -> Floats:
    """Return the Wasserstein-1 distances between the shape distributions of all pairs, (n, n) [mm]."""
    quantiles = np.array([distance_quantiles(mesh) for mesh in meshes.values()])
    return np.asarray(np.abs(quantiles[:, None] - quantiles[None]).mean(axis=2))


def medoid(meshes: Mapping[str, TriMesh]) -> str:
    """Return the id of the shape with the smallest sum of distances to the others; the first id wins a tie.

    Ties are common: of an even number of shapes that differ mostly in size, the two middle ones have the same sum, but for rounding.

    Examples
    --------
    >>> from ssmpipe.core.mesh.primitives import sphere
    >>> medoid({"a": sphere(1.0, 2), "b": sphere(2.0, 2), "c": sphere(5.0, 2)})
    'b'
    """
    ids = sorted(meshes)
    total = distribution_distances({i: meshes[i] for i in ids}).sum(axis=1)
    return ids[int(np.flatnonzero(total <= (1.0 + TIE) * total.min())[0])]

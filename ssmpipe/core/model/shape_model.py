"""The linear statistical shape model: mean, modes, variances."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.correspondence.window import Window
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.outline.outline import Outline


@dataclass(frozen=True, eq=False)
class Chain:
    """How the shapes of a model were made from their scans: what it takes to bring a new scan into it.

    Parameters
    ----------
    text : str
        JSON: units, roles, seed, and every step with stage, version and all its options (see ``runner/chain.py``).
    prepared : mapping of str to TriMesh or Outline
        What the steps had in common, by ``<step>.<slot>``: ``align.reference`` [mm, aligned frame].
    """

    text: str
    prepared: Mapping[str, TriMesh | Outline] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class ShapeModel:
    """Principal component model of corresponded points.

    Parameters
    ----------
    ids : tuple of str
        Shapes it was built from.
    mean : (n_P, d)
        Mean points [mm].
    modes : (n_modes, n_P, d)
        Orthonormal modes of variation (as vectors of length n_P d), sign fixed.
    variances : (n_modes,)
        Variance along each mode [mm^2], decreasing; divisor n_S - 1.
    scores : (n_S, n_modes)
        Coefficients of the shapes in units of one standard deviation.
    grid : tuple of int
    faces : (n_F, 3)
    topology : str
    lambda_cut : float
        Variance below which a mode counted as noise in the optimization [mm^2]; NaN where it is not known.
    window : Window, optional
        Part of the parameter domain that it covers, where rims were free.
    normals : (n_S, n_P, d), optional
        Unit normals of the training points, where the correspondence weighed them.
    normal_scale : float
        With what [mm].
    chain : Chain, optional
        None for a model that was not built by a run, or by a version that did not keep it.
    """

    ids: tuple[str, ...]
    mean: Floats
    modes: Floats
    variances: Floats
    scores: Floats
    grid: tuple[int, ...]
    faces: Ints
    topology: str
    lambda_cut: float = float("nan")
    window: Window | None = None
    normals: Floats | None = None
    normal_scale: float = 0.0
    chain: Chain | None = None

    @property
    def training_points(self) -> Floats:
        """Points of the shapes that the model was built from, (n_S, n_P, d) [mm]; exact, since no mode was left out."""
        return np.stack([self.instance(row) for row in self.scores])

    def instance(self, sigmas: Floats) -> Floats:
        """Return the (n_P, d) points at ``sigmas`` standard deviations along the leading modes."""
        k = len(sigmas)
        return self.mean + ((sigmas * self.variances[:k] ** 0.5)[:, None, None] * self.modes[:k]).sum(axis=0)

    def project(self, points: Floats) -> Floats:
        """Return the coefficients of corresponded points that lie in the frame of the model, in standard deviations.

        Parameters
        ----------
        points : (n_P, d) float64
            In the order of the mean [mm].

        Returns
        -------
        (n_modes,) float64
        """
        return np.asarray(np.einsum("mld,ld->m", self.modes, points - self.mean) / np.sqrt(self.variances))

"""The linear statistical shape model: mean, modes, variances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmpipe.core.arrays import Floats, Ints


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
    """

    ids: tuple[str, ...]
    mean: Floats
    modes: Floats
    variances: Floats
    scores: Floats
    grid: tuple[int, ...]
    faces: Ints
    topology: str

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

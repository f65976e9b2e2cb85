"""Where named landmarks lie in the domains of a cohort: the places that guides carry onto each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ssmpipe.core.arrays import Bools, Floats
from ssmpipe.core.correspondence.guides import Guides
from ssmpipe.core.correspondence.reparameterization import Reparameterization
from ssmpipe.core.errors import LandmarkError
from ssmpipe.core.spline.evaluate import Spline, SplineStack
from ssmpipe.core.spline.project import nearest_parameters


@dataclass(frozen=True, eq=False)
class GuidePlaces:
    """Named landmarks in the domain.

    Parameters
    ----------
    common : (n_K, d_par)
        Where all shapes shall have them: the place on the reference, else the mean of all.
    own : (n_S, n_K, d_par)
        Where each shape has them; zero where it lacks one.
    tangents : (n_S, n_K, d_par, d)
        Derivatives of the shapes there [mm].
    present : (n_S, n_K) bool
    """

    common: Floats
    own: Floats
    tangents: Floats
    present: Bools

    @classmethod
    def of(
        cls,
        splines: Sequence[Spline],
        stack: SplineStack,
        guides: Sequence[Mapping[str, Floats]],
        reference: int,
        *,
        periodic: bool,
    ) -> GuidePlaces:
        """Find the landmarks that at least two shapes have.

        Parameters
        ----------
        splines : sequence of Spline
        stack : SplineStack
            Of the same.
        guides : sequence of mapping name -> (d,)
            Per shape, in the frame of the splines [mm].
        reference : int
            Shape whose places count; -1 for none.
        periodic : bool
            Whether the first direction closes.

        Raises
        ------
        LandmarkError
            If no name is marked on two shapes.
        """
        names = sorted({n for g in guides for n in g if sum(n in other for other in guides) >= 2})
        if not names:
            raise LandmarkError(
                "no guide is marked on two shapes or more", "name landmarks that the shapes share in optimize.guides"
            )
        n_d = len(splines[0].degrees)
        own = np.zeros((len(splines), len(names), n_d))
        present = np.zeros((len(splines), len(names)), dtype=bool)
        for i, (spline, marks) in enumerate(zip(splines, guides, strict=True)):
            have = [k for k, name in enumerate(names) if name in marks]
            if have:
                own[i, have] = nearest_parameters(spline, np.array([marks[names[k]] for k in have]))[0]
                present[i, have] = True
        if reference >= 0:
            anchor = np.where(present[reference][:, None], own[reference], np.nan)
        else:
            anchor = np.full((len(names), n_d), np.nan)
        offset = np.where(present[..., None], own, np.nan)
        if periodic:
            first = np.where(
                np.isnan(anchor[:, 0]), offset[present.argmax(axis=0), np.arange(len(names)), 0], anchor[:, 0]
            )
            offset[..., 0] -= np.round(offset[..., 0] - first)
        common = np.where(np.isnan(anchor), np.nanmean(offset, axis=0), anchor)
        return cls(common, own, np.stack(stack.evaluate(own).first, axis=2), present)

    def guides_in(self, space: Reparameterization, weight: float) -> Guides:
        """Return the guides of the maps of a space; ``weight`` [nat / mm^2]."""
        wrapped = np.where(np.array(space.periodic), self.common - np.floor(self.common), self.common)
        return Guides(space, wrapped, self.own, self.tangents, self.present, weight)

    def distances(self, guides: Guides, coefficients: Floats) -> Floats:
        """Return the (n_S, n_K) distances on the surface that maps leave [mm], NaN where a shape lacks the landmark."""
        moved = np.einsum("ika,ikad->ikd", guides.residual(coefficients), self.tangents)
        return np.where(self.present, np.linalg.norm(moved, axis=-1), np.nan)

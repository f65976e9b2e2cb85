"""Where every shape of a cohort stands, and what of it the objective does not see: sizes, or linear maps to the mean as well."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ssmpipe.core.align.affine import affine_to_mean
from ssmpipe.core.align.procrustes import Alignment, generalized_procrustes
from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.measure import grid_size_weights
from ssmpipe.core.spline.evaluate import Spline


@dataclass(frozen=True, eq=False)
class Pose:
    """Rigid poses of a cohort, and the normalization inside the objective: ``x -> A (R x + t) + a`` for every shape.

    Parameters
    ----------
    alignment : Alignment
        ``R`` and ``t``, from the input frame; results are given in these poses.
    linear : (n_S, d, d)
        ``A``: size factors, or linear maps to the mean shape.
    offset : (n_S, d)
        ``a`` [mm].

    Examples
    --------
    >>> square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    >>> pose = Pose.of(np.stack([square, 3 * square + 5]), (4,), (True,), remove_size=True, keep_pose=False)
    >>> seen = pose.normalized(np.stack([square, 3 * square + 5]))
    >>> bool(np.allclose(seen[0], seen[1]))
    True
    """

    alignment: Alignment
    linear: Floats
    offset: Floats

    @classmethod
    def of(
        cls, points: Floats, grid: tuple[int, ...], periodic: tuple[bool, ...], *, remove_size: bool, keep_pose: bool
    ) -> Pose:
        """Align (n_S, n_P, d) points on a grid, landmarks weighed by the size they stand for; only sizes where the pose is kept."""
        weights = grid_size_weights(points.mean(axis=0), grid, periodic)
        alignment = generalized_procrustes(points, weights, remove_size=remove_size)
        if keep_pose:
            unturned = np.repeat(np.eye(points.shape[2])[None], len(points), axis=0)
            alignment = replace(alignment, rotation=unturned, translation=np.zeros((len(points), points.shape[2])))
        linear = alignment.scale[:, None, None] * np.eye(len(alignment.centre))
        return cls(alignment, linear, alignment.centre - np.einsum("iab,b->ia", linear, alignment.centre))

    def mapped_to_mean(self, points: Floats, grid: tuple[int, ...], periodic: tuple[bool, ...]) -> Pose:
        """Return the same poses with linear maps to the mean of the (n_S, n_P, d) points after those of this pose."""
        sized = self.normalized(points)
        weights = grid_size_weights(sized.mean(axis=0), grid, periodic)
        linear, offset = affine_to_mean(sized, weights)
        return replace(self, linear=linear @ self.linear, offset=np.einsum("iab,ib->ia", linear, self.offset) + offset)

    def placed(self, points: Floats) -> Floats:
        """Move (n_S, n, d) points of the input frame to their poses, sizes kept."""
        return points @ np.swapaxes(self.alignment.rotation, 1, 2) + self.alignment.translation[:, None]

    def normalized(self, points: Floats) -> Floats:
        """Return (n_S, n, d) points of the input frame as the objective sees them."""
        return self.placed(points) @ np.swapaxes(self.linear, 1, 2) + self.offset[:, None]

    def normalized_spline(self, spline: Spline, i: int) -> Spline:
        """Return the spline of shape ``i`` as the objective sees it; splines are affinely invariant."""
        shape = spline.control_points.shape
        moved = spline.control_points @ self.alignment.rotation[i].T + self.alignment.translation[i]
        return spline.with_control((moved @ self.linear[i].T + self.offset[i]).reshape(shape))

"""How far a correspondence carries expert landmarks from where the experts put them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.evaluation.locating import locate


@dataclass(frozen=True, eq=False)
class Transfer:
    """Transfer errors of one landmark.

    Parameters
    ----------
    name : str
    ids : tuple of str
        Shapes that have the landmark on the corresponded part.
    errors : (n, n)
        ``errors[i, j]``: from shape i carried to shape j, distance to j's own landmark [mm]; the diagonal is not counted.
    """

    name: str
    ids: tuple[str, ...]
    errors: Floats

    def off_diagonal(self) -> Floats:
        """Return the errors over all ordered pairs of different shapes."""
        return self.errors[~np.eye(len(self.ids), dtype=bool)]


def landmark_transfer(
    points: Floats,
    faces: Ints,
    ids: Sequence[str],
    landmarks: Mapping[str, Mapping[str, Floats]],
    *,
    max_distance: float = 5.0,
) -> list[Transfer]:
    """Carry every landmark from every shape to every other one through the correspondence.

    Parameters
    ----------
    points : (n_S, n_P, d) float64
        Corresponded points [mm], in the frame of the landmarks.
    faces : (n_F, 3) int64, or (n_E, 2) int64
        Triangles of a surface, or edges of a curve.
    ids : sequence of str
    landmarks : mapping id -> name -> (d,)
    max_distance : float, default=5
        A landmark farther from its surface than this does not lie on the corresponded part and is left out [mm].

    Returns
    -------
    list of Transfer
        Landmarks that at least two shapes have, sorted by name.

    Notes
    -----
    The landmark is projected to its own surface, its barycentric coordinates are evaluated on the other surface, and the
    distance is taken to the other shape's landmark as given, not projected.
    """
    names = sorted({name for i in ids for name in landmarks.get(i, {})})
    located: dict[str, list[tuple[int, Ints, Floats]]] = {name: [] for name in names}
    for i, shape in enumerate(ids):
        own = [name for name in names if name in landmarks.get(shape, {})]
        if not own:
            continue
        marks = np.array([landmarks[shape][name] for name in own])
        distance, face, barycentric = locate(marks, points[i], faces)
        for name, d, f, b in zip(own, distance, face, barycentric, strict=True):
            if d <= max_distance:
                located[name].append((i, faces[f], b))
    transfers = []
    for name in names:
        rows = located[name]
        if len(rows) < 2:
            continue
        own_index = [i for i, _, _ in rows]
        targets = np.array([landmarks[ids[i]][name] for i in own_index])
        carried = np.stack([np.einsum("k,jkd->jd", b, points[own_index][:, f]) for _, f, b in rows])
        errors = np.linalg.norm(carried - targets[None], axis=-1)
        transfers.append(Transfer(name, tuple(ids[i] for i in own_index), errors))
    return transfers

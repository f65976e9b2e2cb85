"""The shapes behind a model: their points, their place in the scans, their columns in the cohort table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.errors import ArtifactError
from ssmpipe.core.mesh.operators import vertex_normals
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.io.arrays import read_npz
from ssmpipe.io.tables import read_cohort
from ssmpipe.use.model import Model


@dataclass(frozen=True, eq=False)
class Shapes:
    """The shapes that a model was built from.

    Parameters
    ----------
    model : Model
    points, points_scan : (n_S, n_P, d) float64
        In the frame of the model [mm], and in the coordinates of the scans.
    transforms : (n_S, 4, 4) float64
        Scan to model.
    columns : dict of str to dict
        Columns of the cohort table by shape id.
    """

    model: Model
    points: Floats
    points_scan: Floats
    transforms: Floats
    columns: dict[str, dict[str, str]]

    def surface(self, index: int, *, scan: bool) -> TriMesh:
        """Return the corresponded surface of a shape, outward oriented also where the scan was mirrored.

        Vertices have the order of the points; the copies of a pole are merged.
        """
        mirrored = scan and np.linalg.det(self.transforms[index, :3, :3]) < 0
        keep, faces = distinct(self.model)
        points = (self.points_scan if scan else self.points)[index]
        return TriMesh(points[keep], faces[:, ::-1] if mirrored else faces)


def distinct(model: Model) -> tuple[Ints, Ints]:
    """Return the numbers of the grid points without the copies of a pole, (n,), and the triangles between them, (n_F, 3)."""
    n_points = len(model.mean)
    first = np.arange(n_points)
    if model.topology in ("cone", "closed"):
        grid = first.reshape(model.shape_model.grid)
        for row in (-1, 0) if model.topology == "closed" else (-1,):
            grid[:, row] = grid[0, row]
        first = grid.reshape(-1)
    keep = np.unique(first)
    faces = np.searchsorted(keep, first[model.shape_model.faces])
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return keep, faces[whole]


def shell_distances(model: Model, points: Floats) -> Floats:
    """Return the signed distance of shapes from the mean along the normal of the mean (Li 2015, figure 5.20).

    Parameters
    ----------
    model : Model
        Of surfaces.
    points : (n_S, n_P, 3) float64
        In the frame of the model [mm].

    Returns
    -------
    (n_S, n) float64
        At the points that :func:`distinct` keeps [mm].
    """
    keep, faces = distinct(model)
    mean = model.mean[keep]
    return np.asarray(np.einsum("sij,ij->si", points[:, keep] - mean, vertex_normals(TriMesh(mean, faces))))


def load_shapes(model: Model) -> Shapes:
    """Read ``correspondence.npz`` and ``scores.csv`` of the run that made a model.

    Raises
    ------
    ArtifactError
        If the model was moved away from its run, or does not belong to it.
    """
    path = model.path.parent.parent / "optimize" / "correspondence.npz"
    if not path.is_file():
        raise ArtifactError(
            f"there is no optimize/correspondence.npz beside the folder of {model.path.name}",
            "give the output folder of the run instead of a copy of the model",
        )
    names = ("ids", "points", "points_scan", "transform")
    ids, points, points_scan, transforms = (read_npz(path, names)[name] for name in names)
    if tuple(ids.tolist()) != model.ids or points.shape[1:] != model.mean.shape:
        raise ArtifactError("model.npz and correspondence.npz belong to different runs", "run the stage model again")
    scores = model.path.with_name("scores.csv")
    table = read_cohort(scores) if scores.is_file() else {}
    columns = {key: {k: v for k, v in row.items() if not k.startswith("mode_")} for key, row in table.items()}
    return Shapes(model, points, points_scan, transforms, columns)

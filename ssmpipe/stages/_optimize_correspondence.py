"""The result of the stage ``optimize`` carried back to the scans: points, and a surface per shape."""

from __future__ import annotations

import numpy as np

from ssmpipe.core.arrays import Floats, Ints
from ssmpipe.core.correspondence.choices import closes
from ssmpipe.core.correspondence.correspondence import Correspondence
from ssmpipe.core.correspondence.optimum import Optimum
from ssmpipe.core.correspondence.options import EngineOptions
from ssmpipe.core.mesh.grid import grid_faces
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.outline.outline import Outline


def correspondence_of(
    optimum: Optimum, ids: tuple[str, ...], topology: str, transform: dict[str, Floats], options: EngineOptions
) -> Correspondence:
    """Return the correspondence in the aligned frame and in the coordinates of the scans; what a seam or a pole repeats is stored once.

    Parameters
    ----------
    optimum : Optimum
    ids : tuple of str
        Of the shapes, in the order of the optimum.
    topology : str
        Of all shapes.
    transform : dict of (4, 4) float64
        Scan to the frame of the splines, per shape.
    options : EngineOptions
        Of the optimization.
    """
    d = optimum.points.shape[2]
    matrices = np.repeat(np.eye(4)[None], len(ids), axis=0)
    matrices[:, :d, :d] = optimum.alignment.rotation
    matrices[:, :d, 3] = optimum.alignment.translation
    matrices = matrices @ np.stack([transform[i] for i in ids])
    back = np.linalg.inv(matrices)

    def to_scan(points: Floats) -> Floats:
        return points @ np.swapaxes(back[:, :d, :d], 1, 2) + back[:, None, :d, 3]

    grid = options.landmarks
    wraps = closes(topology)
    if wraps and options.boundary != "periodic":
        grid = (grid[0] - 1, *grid[1:])  # the seam stays, and is stored once all the same
    poles = {end: topology == "closed" or (topology == "cone" and end == -1) for end in (0, -1)}
    faces = np.empty((0, 3), dtype=np.int64)
    if len(grid) == 2:
        faces = grid_faces(*grid, periodic_u=wraps, pole_start=poles[0], pole_end=poles[-1])

    def stored(points: Floats) -> Floats:
        kept = points[:, : int(np.prod(grid))].copy()
        field = kept.reshape(len(kept), *grid, -1)
        for end in (end for end, is_one in poles.items() if is_one and points.shape[2] == d):
            field[:, :, end] = field[:, :1, end]  # one point to the bit
        return kept

    points, initial = stored(optimum.points), stored(optimum.initial_points)
    return Correspondence(
        ids=ids,
        points=points,
        points_scan=to_scan(points),
        initial_points=initial,
        initial_points_scan=to_scan(initial),
        transform=matrices,
        scale=optimum.alignment.scale,
        parameters=optimum.parameters[:, : int(np.prod(grid))],
        grid=grid,
        faces=faces,
        topology=topology,
        reference=optimum.reference,
        description_length=np.array(optimum.description_length),
        lambda_cut=optimum.lambda_cut,
        eigenvalues_initial=optimum.eigenvalues_initial,
        eigenvalues=optimum.eigenvalues,
        coefficients=optimum.coefficients,
        window=optimum.window,
        normals=stored(optimum.normals) if optimum.normals is not None else None,
        normal_scale=optimum.normal_scale,
    )


def corresponded_surfaces(correspondence: Correspondence) -> dict[str, TriMesh | Outline]:
    """Return one surface (or planar outline) per shape in scan coordinates.

    Mirrored shapes get the same triangles, wound outward.
    """
    out: dict[str, TriMesh | Outline] = {}
    planar = correspondence.points.shape[2] == 2
    if len(correspondence.faces) == 0 and not planar:
        return out
    for i, points, matrix in zip(correspondence.ids, correspondence.points_scan, correspondence.transform, strict=True):
        if planar:
            out[i] = Outline(points, correspondence.topology == "curve-closed")
            continue
        mirrored = np.linalg.det(matrix[:3, :3]) < 0
        faces: Ints = correspondence.faces[:, ::-1] if mirrored else correspondence.faces
        out[i] = TriMesh(points, faces)
    return out

"""Write a model in the format of another program, chosen by suffix."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import ArtifactError
from ssmpipe.core.spline.fit import interpolating_surface
from ssmpipe.io.cad import CAD_SUFFIXES, write_cad
from ssmpipe.io.mesh_formats import vtp
from ssmpipe.io.meshes import write_mesh
from ssmpipe.io.statismo import write_statismo
from ssmpipe.use.model import Model

_MESHES = (".ply", ".stl", ".obj", ".off")


def export_model(model: Model, path: Path, coefficients: Floats | None = None) -> str:
    """Write ``path``; return one line that says what it holds.

    ``.h5``: the whole model in the layout of statismo, which Scalismo reads. ``.ply .stl .obj .off``: the mean (or the instance at
    ``coefficients``) as a mesh. ``.vtp``: the same, with every mode as a displacement of one standard deviation per vertex.
    ``.step .iges``: the same as one B-spline surface (needs ``ssmpipe[cad]``).

    Raises
    ------
    ArtifactError
        If the suffix is none of these.
    """
    suffix = path.suffix.lower()
    points = model.instance(np.zeros(0) if coefficients is None else coefficients)
    path.parent.mkdir(parents=True, exist_ok=True)
    what = "mean" if coefficients is None else "instance"
    if suffix == ".h5":
        write_statismo(path, model.shape_model)
        return f"model with {len(model.variances)} modes, statismo layout"
    if suffix in _MESHES:
        write_mesh(path, model.surface(points))
        return f"{what} as a mesh"
    if suffix == ".vtp":
        one_sigma = np.sqrt(model.variances)[:, None, None] * model.modes
        data = {f"mode_{k + 1:02d}": mode for k, mode in enumerate(one_sigma)}
        model.surface(points)
        path.write_bytes(vtp.dump(points, model.shape_model.faces, data))
        return f"{what} with {len(data)} modes as displacements of one standard deviation"
    if suffix in CAD_SUFFIXES:
        model.surface(points)
        grid = points.reshape(*model.shape_model.grid, 3)
        write_cad(path, interpolating_surface(grid, closed_u=model.topology != "disk"))
        return f"{what} as one bicubic B-spline surface through all {len(points)} points"
    known = ", ".join((".h5", ".vtp", *_MESHES, *CAD_SUFFIXES))
    raise ArtifactError(f"'{path.suffix}' is not a format that a model can be exported to", f"use one of {known}")

"""ShapeWorks projects: a ``.swproj`` file (JSON), particles as text, one surface per shape (ShapeWorks project format 2).

``local_particles`` lie in the space of ``shape`` and ``groomed``, ``world_particles`` in that of the model; ``alignment`` followed by
``procrustes`` takes the first to the second. All values of the file are text, paths are relative to it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import ArtifactError
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.io.meshes import write_mesh

_IDENTITY = np.eye(4)
_OWN = ("name", "shape_1", "groomed_1", "local_particles_1", "world_particles_1", "alignment_1", "procrustes_1")


def write_shapeworks(
    path: Path,
    ids: Sequence[str],
    surfaces: Sequence[TriMesh],
    local: Sequence[Floats],
    world: Sequence[Floats],
    transforms: Sequence[Floats],
    columns: Mapping[str, Mapping[str, str]],
) -> list[str]:
    """Write a project that ShapeWorks Studio opens; return the names of all files, the project first.

    Parameters
    ----------
    path : Path
        ``.swproj``; a folder ``<stem>_particles`` and a folder ``<stem>_shapes`` are written beside it.
    ids : sequence of str
    surfaces : sequence of TriMesh
        In the space of the local particles.
    local, world : sequence of (n_P, 3) float64
        Same row, same place.
    transforms : sequence of (4, 4) float64
        From local to world.
    columns : mapping of str to mapping
        Further columns by shape id, such as ``group``.
    """
    particles, shapes = path.with_name(f"{path.stem}_particles"), path.with_name(f"{path.stem}_shapes")
    for folder in (particles, shapes):
        folder.mkdir(parents=True, exist_ok=True)
    rows, files = [], [path.name]
    for i, shape_id in enumerate(ids):
        mesh = shapes / f"{shape_id}.ply"
        places = [particles / f"{shape_id}_{kind}.particles" for kind in ("local", "world")]
        write_mesh(mesh, surfaces[i])
        for place, points in zip(places, (local[i], world[i]), strict=True):
            place.write_text(particle_text(points), encoding="ascii", newline="\n")
        names = [f"{file.parent.name}/{file.name}" for file in (mesh, mesh, *places)]
        row = dict(
            zip(_OWN, [shape_id, *names, _transform_text(transforms[i]), _transform_text(_IDENTITY)], strict=True)
        )
        for name, value in columns.get(shape_id, {}).items():
            key = f"group_{name}" if name == "group" else name
            if key not in row and not key.startswith(("shape_", "mesh_", "groomed_", "local_", "world_")):
                row[key] = value
        rows.append(row)
        files += names[1:]
    content: dict[str, Any] = {
        "data": rows, "groom": {}, "optimize": {"number_of_particles": {"1": str(len(local[0]))}}, "studio": {},
        "project": {"version": "2"}, "analysis": {}, "deepssm": {}, "landmarks": [],
    }  # fmt: skip
    path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8", newline="\n")
    return files


def particle_text(points: Floats) -> str:
    """Return points as ShapeWorks writes them: ``x y z`` on a line each, nothing else.

    Examples
    --------
    >>> particle_text(np.array([[0.0, 1.5, -2.0]]))
    '0.0 1.5 -2.0\\n'
    """
    return "".join(" ".join(map(repr, row)) + "\n" for row in points.tolist())


def read_particles(path: Path) -> Floats:
    """Return the points of a ``.particles`` file, (n_P, 3).

    Raises
    ------
    ArtifactError
        If a line does not hold three finite numbers.
    """
    rows = [line.split() for line in path.read_text(encoding="ascii").splitlines() if line.strip()]
    try:
        points = np.array(rows, dtype=np.float64).reshape(-1, 3)
    except ValueError as error:
        raise ArtifactError(f"{path.name} does not hold x y z in every line", "export the particles again") from error
    if not np.isfinite(points).all():
        raise ArtifactError(f"{path.name} has numbers that are not finite", "export the particles again")
    return points


def _transform_text(matrix: Floats) -> str:
    return " ".join(repr(float(x)) for x in np.asarray(matrix).reshape(-1))

"""Write a model, or the shapes behind it, in the format of another program, chosen by suffix."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np

from ssmpipe.contract import Table
from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import ConfigError
from ssmpipe.core.outline.outline import Outline
from ssmpipe.core.spline.fit import interpolating_surface
from ssmpipe.core.statistics.covariates import centroid_size
from ssmpipe.io.cad import CAD_SUFFIXES, write_cad
from ssmpipe.io.gias import write_gias
from ssmpipe.io.mesh_formats import vtp
from ssmpipe.io.meshes import write_mesh
from ssmpipe.io.outlines import write_outline
from ssmpipe.io.shapeworks import write_shapeworks
from ssmpipe.io.statismo import write_statismo
from ssmpipe.io.tables import read_cohort, write_table
from ssmpipe.use.groups import shape_points
from ssmpipe.use.model import SURFACES, Model
from ssmpipe.use.results import distinct, load_shapes, shell_distances

_MESHES = (".ply", ".stl", ".obj", ".off")
_WHOLE = (".h5", ".swproj", ".pc.npz", ".csv")


def export_model(model: Model, path: Path, coefficients: Floats | None = None) -> str:
    """Write ``path``; return one line that says what it holds.

    ``.h5``: the whole model in the layout of statismo, which Scalismo reads. ``.pc.npz``: in that of gias. ``.swproj``: a ShapeWorks
    project with particles and surfaces of all shapes beside it. ``.csv``: a row per shape with its columns of the cohort
    table, scores and points, for R. ``.ply .stl .obj .off``: the mean (or the instance at ``coefficients``) as a mesh. ``.vtp``: the same,
    with every mode as a displacement of one standard deviation per vertex, the distance of every shape from the mean, and scores and
    variances as field data. ``.step .iges``: the same as one B-spline surface (needs ``ssmpipe[cad]``).

    Raises
    ------
    ArtifactError
        If a file of the run is needed and not there.
    ConfigError
        If the suffix is none of these, or coefficients are given for a format that holds the whole model.
    """
    suffix = path.suffix.lower()
    whole = next((s for s in _WHOLE if path.name.lower().endswith(s)), "")
    known = (*_WHOLE, ".vtp", *_MESHES, *CAD_SUFFIXES)
    if not whole and suffix not in known:
        raise ConfigError(
            f"'{path.suffix}' is not a format that a model can be exported to", f"use one of {', '.join(known)}"
        )
    if whole and coefficients is not None:
        raise ConfigError(f"{whole} holds the whole model, not one instance", "leave --at out")
    path.parent.mkdir(parents=True, exist_ok=True)
    if whole == ".h5":
        write_statismo(path, model.shape_model)
        return f"model with {len(model.variances)} modes, statismo layout"
    if whole == ".pc.npz":
        write_gias(path, model.shape_model)
        return f"model with {len(model.variances)} modes, gias layout"
    if whole == ".csv":
        return _write_csv(model, path)
    if whole == ".swproj":
        return _write_project(model, path)
    points = model.instance(np.zeros(0) if coefficients is None else coefficients)
    what = "mean" if coefficients is None else "instance"
    if suffix in _MESHES:
        write_mesh(path, model.surface(points))
        return f"{what} as a mesh"
    if suffix == ".vtp":
        return f"{what} with {_write_vtp(model, path, points)}"
    model.surface(points)
    grid = points.reshape(*model.shape_model.grid, 3)
    write_cad(path, interpolating_surface(grid, closed_u=model.topology != "disk"))
    return f"{what} as one bicubic B-spline surface through all {len(points)} points"


def export_shapes(
    model: Model, folder: Path, suffix: str, frame: Literal["scan", "model"] = "scan", ids: tuple[str, ...] = ()
) -> list[str]:
    """Write the corresponded surface (or outline) of every shape; return the names of the files.

    Parameters
    ----------
    model : Model
        Inside the output folder of its run.
    folder : Path
    suffix : str
        ``.ply .stl .vtp .obj .off``; outlines are always ``.csv``. ``.vtp`` holds the distance from the mean along its normal and the
        displacement from the mean at every point [mm, frame of the model], and the scores as field data.
    frame : {"scan", "model"}
        Coordinates of the scan file, or those of the model.
    ids : tuple of str
        Only these shapes.

    Raises
    ------
    ArtifactError
        If the files of the run are not there.
    ConfigError
        If a shape does not exist.
    """
    shapes = load_shapes(model)
    strange = sorted(set(ids) - set(model.ids))
    if strange:
        raise ConfigError(f"there is no shape '{strange[0]}' in the model", f"it has {', '.join(model.ids[:5])} ...")
    folder.mkdir(parents=True, exist_ok=True)
    names = []
    for i, shape_id in enumerate(model.ids):
        if ids and shape_id not in ids:
            continue
        if model.topology not in SURFACES:
            points = (shapes.points_scan if frame == "scan" else shapes.points)[i]
            names.append(f"{shape_id}.csv")
            write_outline(folder / names[-1], Outline(points, model.topology == "curve-closed"))
            continue
        mesh = shapes.surface(i, scan=frame == "scan")
        names.append(f"{shape_id}{suffix}")
        if suffix == ".vtp":
            keep, _ = distinct(model)
            moved = (shapes.points[i] - model.mean)[keep]
            data = {"distance": shell_distances(model, shapes.points[i : i + 1])[0], "displacement": moved}
            content = vtp.dump(mesh.vertices, mesh.faces, data, {"scores": model.scores[i]})
            (folder / names[-1]).write_bytes(content)
        else:
            write_mesh(folder / names[-1], mesh)
    return names


def _write_vtp(model: Model, path: Path, points: Floats) -> str:
    model.surface(points)
    keep, faces = distinct(model)
    one_sigma = np.sqrt(model.variances)[:, None, None] * model.modes
    data: dict[str, Floats] = {f"mode_{k + 1:02d}": mode[keep] for k, mode in enumerate(one_sigma)}
    distances = shell_distances(model, shape_points(model.shape_model))
    data |= {f"distance_{i}": row for i, row in zip(model.ids, distances, strict=True)}
    fields = {"variances": model.variances, "scores": model.scores}
    path.write_bytes(vtp.dump(points[keep], faces, data, fields))
    return f"{len(one_sigma)} modes as displacements of one standard deviation and the distances of {len(distances)} shapes"


def _write_csv(model: Model, path: Path) -> str:
    """One row a shape: id, columns of the cohort table, centroid size, scores, then x, y[, z] of point after point."""
    points = shape_points(model.shape_model)
    scores = model.path.with_name("scores.csv")
    table = read_cohort(scores) if scores.is_file() else {}
    columns: dict[str, list[Any]] = {"id": list(model.ids)}
    for name in {key: None for row in table.values() for key in row if not key.startswith("mode_")}:
        columns[name] = [table.get(i, {}).get(name, "") for i in model.ids]
    columns["centroid_size"] = centroid_size(points).tolist()
    digits = len(str(points.shape[1]))
    values: dict[str, list[Any]] = {
        f"mode_{k + 1:02d}": model.scores[:, k].tolist() for k in range(model.scores.shape[1])
    }
    for p in range(points.shape[1]):
        for axis in range(points.shape[2]):
            values[f"p{p + 1:0{digits}d}_{'xyz'[axis]}"] = points[:, p, axis].tolist()
    clash = sorted(set(values) & set(columns))
    if clash:
        raise ConfigError(f"the cohort table has a column '{clash[0]}', which the export needs", "rename it")
    write_table(path, Table(columns | values))
    return f"{len(model.ids)} shapes, {model.scores.shape[1]} scores and {points.shape[1]} points each, a row per shape"


def _write_project(model: Model, path: Path) -> str:
    if model.topology not in SURFACES:
        raise ConfigError("a ShapeWorks project holds surfaces, this model is one of curves", "export .csv")
    shapes = load_shapes(model)
    keep, _ = distinct(model)
    surfaces = [shapes.surface(i, scan=True) for i in range(len(model.ids))]
    local, world = list(shapes.points_scan[:, keep]), list(shapes.points[:, keep])
    files = write_shapeworks(path, model.ids, surfaces, local, world, list(shapes.transforms), shapes.columns)
    return f"ShapeWorks project, {len(model.ids)} shapes with {len(keep)} particles, {len(files)} files"

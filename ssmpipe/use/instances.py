"""Write the mean, walks along modes and random instances of a model as meshes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ssmpipe.contract import Table
from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import ConfigError
from ssmpipe.core.outline.outline import Outline
from ssmpipe.io.mesh_formats import vtp
from ssmpipe.io.meshes import write_mesh
from ssmpipe.io.outlines import write_outline
from ssmpipe.io.tables import write_table
from ssmpipe.use.model import SURFACES, Model


@dataclass(frozen=True)
class InstanceOptions:
    """What to draw.

    Parameters
    ----------
    modes : sequence of int, optional
        Modes to walk along, from 1; by default the first three.
    extent : float
        Ends of a walk [standard deviations].
    n_steps : int
        Instances per walk, both ends included.
    n_random, seed : int
        Random instances.
    at : mapping of int to float, optional
        One instance at these coefficients, mode by number.
    suffix : str
        Of the mesh files: ``.ply .stl .vtp .obj .off``.
    watertight : bool
        Whether openings get a lid.
    quads : bool
        Whether each instance is also written as a shell of quadrilaterals (``.vtp``), with its quality.
    """

    modes: Sequence[int] | None = None
    extent: float = 3.0
    n_steps: int = 7
    n_random: int = 0
    seed: int = 0
    at: dict[int, float] | None = None
    suffix: str = ".ply"
    watertight: bool = True
    quads: bool = False


def write_instances(model: Model, out: Path, options: InstanceOptions) -> list[str]:
    """Write the instances and ``instances.csv``, a row for each with its coefficients; return the names of the files.

    Raises
    ------
    ConfigError
        If a mode does not exist, or the model is one of curves and a surface was asked for.
    """
    n_modes = len(model.variances)
    walks = range(1, min(3, n_modes) + 1) if options.modes is None else options.modes
    for mode in (*walks, *(options.at or {})):
        if not 1 <= mode <= n_modes:
            raise ConfigError(f"there is no mode {mode}, the model has modes 1 to {n_modes}")
    solid = model.topology in SURFACES
    if options.quads and not solid:
        raise ConfigError("a model of curves has no quadrilaterals")
    names, rows = ["mean"], [np.zeros(n_modes)]
    for mode in walks:
        for step in np.linspace(-options.extent, options.extent, options.n_steps):
            names.append(f"mode_{mode:02d}_{'minus' if step < 0 else 'plus'}{abs(step):.2f}")
            rows.append(step * np.eye(n_modes)[mode - 1])
    if options.at:
        names.append("at_" + "_".join(f"{mode:02d}={value:g}" for mode, value in sorted(options.at.items())))
        row = np.zeros(n_modes)
        row[[mode - 1 for mode in options.at]] = list(options.at.values())
        rows.append(row)
    drawn = model.sample(options.n_random, seed=options.seed)[1]
    width = len(str(max(options.n_random, 1)))
    names += [f"random_{k + 1:0{width}d}" for k in range(options.n_random)]
    rows += list(drawn)
    out.mkdir(parents=True, exist_ok=True)
    files: list[str] = []
    quality: list[Floats] = []
    for name, row in zip(names, rows, strict=True):
        points = model.instance(row)
        if solid:
            files.append(f"{name}{options.suffix}")
            write_mesh(out / files[-1], model.surface(points, watertight=options.watertight))
            quality.append(model.quad_quality(points))
        elif points.shape[1] == 2:
            files.append(f"{name}.csv")
            write_outline(out / files[-1], Outline(points, model.topology == "curve-closed"))
        else:
            files.append(f"{name}.csv")
            write_table(out / files[-1], Table(dict(zip("xyz", points.T.tolist(), strict=True))))
        if options.quads:
            files.append(f"{name}_quads.vtp")
            (out / files[-1]).write_bytes(vtp.dump(points, model.quads()))
    columns: dict[str, Sequence[object]] = {"name": names}
    for m in range(n_modes):
        columns[f"mode_{m + 1:02d}"] = [float(row[m]) for row in rows]
    columns["mahalanobis"] = [model.distance(row) for row in rows]
    if quality:
        columns["smallest_scaled_jacobian"] = [float(q.min()) for q in quality]
        columns["mean_scaled_jacobian"] = [float(q.mean()) for q in quality]
    note = "coefficients in standard deviations; scaled Jacobian of the quadrilaterals of the grid, 1 is best"
    write_table(out / "instances.csv", Table(columns, note))
    return [*files, "instances.csv"]

"""Build the statistical shape model: mean, modes of variation, variances, scores."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import Field

from ssmpipe.contract import Context, Port, ShapeInfo, Stage, StageConfig, Table
from ssmpipe.core.arrays import Floats
from ssmpipe.core.correspondence.correspondence import Correspondence
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.model.pca import principal_components
from ssmpipe.core.model.shape_model import Chain, ShapeModel
from ssmpipe.core.outline.outline import Outline


class Config(StageConfig):
    """Options of ``model``."""

    n_mode_meshes: Annotated[
        int, Field(ge=0, description="How many modes are written as meshes; all modes stay in model.npz.")
    ] = 5
    sigma: Annotated[float, Field(gt=0, description="Extent of the mode meshes [standard deviations].")] = 3.0


def run(
    *,
    correspondence: Correspondence,
    info: dict[str, ShapeInfo],
    chain: Chain | None = None,
    cfg: Config,
    ctx: Context,
) -> dict[str, Any]:
    """Principal components of the optimized points, sizes kept."""
    mean, modes, variances, scores = principal_components(correspondence.points)
    model = ShapeModel(
        ids=correspondence.ids,
        mean=mean,
        modes=modes,
        variances=variances,
        scores=scores,
        grid=correspondence.grid,
        faces=correspondence.faces,
        topology=correspondence.topology,
        lambda_cut=correspondence.lambda_cut,
        window=correspondence.window,
        normals=correspondence.normals,
        normal_scale=correspondence.normal_scale,
        chain=chain,
    )
    ctx.metric("n_modes", len(variances))
    ctx.metric("total_variance_mm2", float(variances.sum() / len(mean)))
    ctx.metric("first_mode_share", float(variances[0] / variances.sum()))
    meshes = {"mean": _drawn(model, mean)}
    label = f"{cfg.sigma:g}"
    for m in range(min(cfg.n_mode_meshes, len(variances))):
        for sign, word in ((-1.0, "minus"), (1.0, "plus")):
            sigmas = np.zeros(m + 1)
            sigmas[m] = sign * cfg.sigma
            meshes[f"mode_{m + 1:02d}_{word}{label}"] = _drawn(model, model.instance(sigmas))
    columns: dict[str, list[Any]] = {"id": list(model.ids)}
    for m in range(len(variances)):
        columns[f"mode_{m + 1:02d}"] = scores[:, m].tolist()
    own = set(columns)
    if any(i in info and info[i].side for i in model.ids):
        columns["side"] = [(info[i].side or "") if i in info else "" for i in model.ids]
    for name in dict.fromkeys(c for i in model.ids if i in info for c in info[i].columns):
        if name not in own:
            columns[name] = [info[i].columns.get(name, "") if i in info else "" for i in model.ids]
    scores_table = Table(columns, "scores in units of one standard deviation of their mode")
    return {"model": model, "model_meshes": meshes, "scores": scores_table}


def _drawn(model: ShapeModel, points: Floats) -> TriMesh | Outline:
    """Return an instance of the model as a file can hold it; a curve in space becomes a mesh without faces."""
    if points.shape[1] == 2:
        return Outline(points, model.topology == "curve-closed")
    return TriMesh(points, model.faces)


STAGE = Stage(
    name="model",
    scope="cohort",
    version=4,  # format 4 of model.npz, with the normals
    config=Config,
    run=run,
    inputs=(
        Port("correspondence", "correspondence"),
        Port("info", "info"),
        Port("chain", "chain", optional=True),
    ),
    outputs=(Port("model", "model"), Port("model_meshes", "meshes"), Port("scores", "table")),
    methods="The model is the principal component analysis of the corresponded points in the aligned frame, sizes kept.",
    cites=("li2015",),
)

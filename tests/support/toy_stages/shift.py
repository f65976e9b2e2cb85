"""Move a mesh to the centre of the reference, with a little noise."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import Field

from ssmpipe.contract import Context, Landmarks, NamesShape, Port, Stage, StageConfig
from ssmpipe.core.mesh.trimesh import TriMesh


class Config(StageConfig):
    """Options of ``shift``."""

    reference: Annotated[
        str, NamesShape(("largest",)), Field(description="Shape to move to: largest, an id, or a file.")
    ] = "largest"
    noise: Annotated[float, Field(ge=0, description="Noise [mm].")] = 0.0
    need: Annotated[str, Field(description="Role that must have a landmark.")] = ""


def prepare(inputs: dict[str, dict[str, Any]], *, cfg: Config, ctx: Context) -> dict[str, Any]:
    name = cfg.reference if cfg.reference in inputs else max(inputs, key=lambda i: np.ptp(inputs[i]["mesh"].vertices))
    ctx.metric("reference", name)
    return {"reference": inputs[name]["mesh"]}


def run(
    mesh: TriMesh, landmarks: Landmarks, transform: Any, reference: TriMesh, *, cfg: Config, ctx: Context
) -> dict[str, Any]:
    if cfg.need:
        landmarks.role(cfg.need)
    move = np.eye(4)
    move[:3, 3] = reference.vertices.mean(axis=0) - mesh.vertices.mean(axis=0)
    move[:3, 3] += cfg.noise * ctx.rng.standard_normal(3)
    if cfg.noise > 1:
        ctx.warn("that is a lot of noise; lower shift.noise")
    return {
        "mesh": TriMesh(mesh.vertices + move[:3, 3], mesh.faces),
        "landmarks": landmarks.transformed(move),
        "transform": move @ transform,
    }


STAGE = Stage(
    name="shift",
    scope="shape",
    version=1,
    config=Config,
    run=run,
    inputs=(
        Port("mesh", "trimesh"),
        Port("landmarks", "landmarks", optional=True),
        Port("transform", "transform"),
        Port("reference", "trimesh"),
    ),
    outputs=(Port("mesh", "trimesh"), Port("landmarks", "landmarks"), Port("transform", "transform")),
    prepare=prepare,
    prepared=(Port("reference", "trimesh"),),
)

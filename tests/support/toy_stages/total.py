"""Average all meshes."""

from __future__ import annotations

import time
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from ssmpipe.contract import Context, Port, Stage, StageConfig, Table
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.mesh.trimesh import TriMesh


class Config(StageConfig):
    """Options of ``total``."""

    weight: Annotated[float, Field(description="Weight [-].")] = 1.0
    refuse: Annotated[bool, Field(description="Whether to refuse.")] = False


def run(mesh: dict[str, TriMesh], *, cfg: Config, ctx: Context) -> dict[str, Any]:
    if cfg.refuse:
        raise GeometryError("the shapes do not agree", "look at them")
    mean = cfg.weight * np.mean([m.vertices for m in mesh.values()], axis=0)
    ctx.progress(1, 1, "done")
    ctx.metric("n_shapes", len(mesh))
    first = next(iter(mesh.values()))
    return {
        "mean": TriMesh(mean, first.faces),
        "history": Table({"iteration": [1], "elapsed_s": [time.perf_counter()]}),
    }


STAGE = Stage(
    name="total",
    scope="cohort",
    version=1,
    config=Config,
    run=run,
    inputs=(Port("mesh", "trimesh"),),
    outputs=(Port("mean", "trimesh"), Port("history", "table", volatile=True)),
)

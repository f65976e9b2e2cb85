"""Scale a mesh, or misbehave on request."""

from __future__ import annotations

import os
import sys
import time
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from ssmpipe.contract import Context, Port, Stage, StageConfig
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.mesh.trimesh import TriMesh


class Config(StageConfig):
    """Options of ``grow``."""

    factor: Annotated[float, Field(gt=0, description="Scale factor [-].")] = 2.0
    note: Annotated[str, Field(description="Does not change the output [-].")] = ""
    refuse: Annotated[tuple[str, ...], Field(description="Shapes to refuse.")] = ()
    abort: Annotated[tuple[str, ...], Field(description="Shapes to crash on.")] = ()
    leave: Annotated[tuple[str, ...], Field(description="Shapes to end the process on.")] = ()
    bug: Annotated[tuple[str, ...], Field(description="Shapes to raise a programming error on.")] = ()
    hang: Annotated[tuple[str, ...], Field(description="Shapes to hang on.")] = ()
    hog: Annotated[tuple[str, ...], Field(description="Shapes to need 4 GB for.")] = ()


def run(mesh: TriMesh, *, cfg: Config, ctx: Context) -> dict[str, Any]:
    if ctx.shape_id in cfg.refuse:
        raise GeometryError("the mesh has 2 components", "keep the largest")
    if ctx.shape_id in cfg.abort:
        os.abort()
    if ctx.shape_id in cfg.leave:
        sys.exit(1)
    if ctx.shape_id in cfg.bug:
        raise ZeroDivisionError("oops")
    if ctx.shape_id in cfg.hang:
        time.sleep(60)
    if ctx.shape_id in cfg.hog:
        np.ones(2**29)
    ctx.metric("n_faces", mesh.n_faces)
    ctx.metric("elapsed_s", time.perf_counter())
    return {"mesh": TriMesh(mesh.vertices * cfg.factor, mesh.faces)}


STAGE = Stage(
    name="grow",
    scope="shape",
    version=1,
    config=Config,
    run=run,
    inputs=(Port("mesh", "trimesh"),),
    outputs=(Port("mesh", "trimesh"),),
    methods="Meshes were scaled by {factor}.",
    cites=("li2015",),
)

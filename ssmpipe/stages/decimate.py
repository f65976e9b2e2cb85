"""Reduce the number of triangles."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, model_validator

from ssmpipe.contract import Context, Port, Stage, StageConfig
from ssmpipe.core.mesh.distance import surface_deviation
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.decimation import Method, decimate


class Config(StageConfig):
    """Options of decimate."""

    n_faces: Annotated[int, Field(ge=100, description="Target number of triangles [count].")] = 10000
    method: Annotated[
        Method,
        Field(
            description="Library that collapses edges; qslim takes over, with a warning, where another one changes the topology."
        ),
    ] = "fast-simplification"
    keep_boundary: Annotated[
        bool, Field(description="Keep every vertex of the boundary, at the cost of the interior.")
    ] = False

    @model_validator(mode="after")
    def _can_keep_the_boundary(self) -> Config:
        if self.keep_boundary and self.method == "qslim":
            raise ValueError("keep_boundary needs method: fast-simplification")
        return self


def run(mesh: TriMesh, *, cfg: Config, ctx: Context) -> dict[str, Any]:
    """Decimate one shape; see :func:`ssmpipe.core.repair.decimation.decimate`."""
    result = decimate(mesh, cfg.n_faces, keep_boundary=cfg.keep_boundary, method=cfg.method)
    if result.method == "qslim" and cfg.method != "qslim":
        ctx.warn(f"{cfg.method} would have changed the topology, so qslim decimated this shape; raise decimate.n_faces")
    ctx.metric("n_vertices", result.mesh.n_vertices)
    ctx.metric("n_faces", result.mesh.n_faces)
    ctx.metric("method", result.method)
    if result.method == "none":
        ctx.log.info("%d faces are no more than the target of %d: nothing to do", mesh.n_faces, cfg.n_faces)
        ctx.metric("deviation_rms_mm", 0.0)
        ctx.metric("deviation_max_mm", 0.0)
        return {"mesh": mesh}
    deviation = surface_deviation(mesh, result.mesh, n_samples=5000)
    ctx.metric("deviation_rms_mm", deviation.rms)
    ctx.metric("deviation_max_mm", deviation.maximum)
    ctx.metric("before_to_after_rms_mm", deviation.rms_a_to_b)
    ctx.metric("before_to_after_max_mm", deviation.max_a_to_b)
    ctx.metric("after_to_before_rms_mm", deviation.rms_b_to_a)
    ctx.metric("after_to_before_max_mm", deviation.max_b_to_a)
    ctx.metric("n_faces_before", mesh.n_faces)
    return {"mesh": result.mesh}


STAGE = Stage(
    name="decimate",
    scope="shape",
    version=2,
    config=Config,
    run=run,
    inputs=(Port("mesh", "trimesh"),),
    outputs=(Port("mesh", "trimesh"),),
    methods="Meshes were decimated to {n_faces} faces by quadric edge collapse ({method}).",
    cites=("garland1997",),
)

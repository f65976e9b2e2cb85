"""Reduce the number of triangles."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from ssmpipe.contract import Context, Port, Stage, StageConfig
from ssmpipe.core.mesh.distance import surface_deviation
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.decimation import decimate


class Config(StageConfig):
    """Options of decimate."""

    n_faces: Annotated[int, Field(ge=100, description="Target number of triangles [count].")] = 10000
    keep_boundary: Annotated[
        bool, Field(description="Keep every vertex of the boundary, at the cost of the interior.")
    ] = False


def run(mesh: TriMesh, *, cfg: Config, ctx: Context) -> dict[str, Any]:
    """Decimate one shape; see :func:`ssmpipe.core.repair.decimation.decimate`."""
    result = decimate(mesh, cfg.n_faces, keep_boundary=cfg.keep_boundary)
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
    return {"mesh": result.mesh}


STAGE = Stage(
    name="decimate",
    scope="shape",
    version=1,
    config=Config,
    run=run,
    inputs=(Port("mesh", "trimesh"),),
    outputs=(Port("mesh", "trimesh"),),
    methods="Meshes were decimated to {n_faces} faces by quadric edge collapse.",
    cites=("garland1997",),
)

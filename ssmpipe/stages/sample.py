"""Read the surface at a regular grid of its square."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import Field

from ssmpipe.contract import Context, Port, Stage, StageConfig
from ssmpipe.core.arrays import Floats
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.parameterize.sampling import sample_grid
from ssmpipe.core.parameterize.seam import Seam


class Config(StageConfig):
    """Options of sample."""

    grid: Annotated[
        tuple[Annotated[int, Field(ge=2)], Annotated[int, Field(ge=2)]],
        Field(description="Grid points in u and v [count]."),
    ] = (200, 200)


def run(mesh: TriMesh, uv: Floats, seam: Seam | None = None, *, cfg: Config, ctx: Context) -> dict[str, Any]:
    """Sample one shape; see :func:`ssmpipe.core.parameterize.sampling.sample_grid`."""
    samples = sample_grid(mesh, uv, *cfg.grid, seam=seam)
    steps = [np.linalg.norm(np.diff(samples, axis=axis), axis=2) for axis in (0, 1)]
    ctx.metric("n_samples", samples.shape[0] * samples.shape[1])
    ctx.metric("largest_step_mm", float(max(s.max() for s in steps)))
    ctx.metric("mean_step_mm", float(np.mean([s.mean() for s in steps])))
    return {"samples": samples}


STAGE = Stage(
    name="sample",
    scope="shape",
    version=1,
    config=Config,
    run=run,
    inputs=(Port("mesh", "trimesh"), Port("uv", "uv"), Port("seam", "seam", optional=True)),
    outputs=(Port("samples", "samples"),),
    methods="Each surface was sampled at a regular {grid} grid of its square by barycentric interpolation.",
    cites=("li2015",),
)

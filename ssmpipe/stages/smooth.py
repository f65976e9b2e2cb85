"""Remove noise without shrinking the surface."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, model_validator

from ssmpipe.contract import Context, Port, Stage, StageConfig
from ssmpipe.core.mesh.distance import surface_deviation
from ssmpipe.core.mesh.operators import area, volume
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.cleaning import close_openings
from ssmpipe.core.repair.smoothing import taubin


class Config(StageConfig):
    """Options of smooth."""

    n_iterations: Annotated[
        int, Field(ge=0, description="Pairs of Taubin steps; a finer mesh needs more for the same effect [count].")
    ] = 10
    lam: Annotated[float, Field(gt=0, lt=1, description="Size of the shrinking step [-].")] = 0.5
    mu: Annotated[
        float, Field(lt=0, gt=-1.2, description="Size of the growing step, larger than lam in magnitude [-].")
    ] = -0.53

    @model_validator(mode="after")
    def _grows_back(self) -> Config:
        if -self.mu <= self.lam:
            raise ValueError(f"mu must be below -lam = {-self.lam}, or the surface shrinks")
        return self


def run(mesh: TriMesh, *, cfg: Config, ctx: Context) -> dict[str, Any]:
    """Smooth one shape; see :func:`ssmpipe.core.repair.smoothing.taubin`."""
    smooth = taubin(mesh, n_iterations=cfg.n_iterations, lam=cfg.lam, mu=cfg.mu)
    before, after = (volume(close_openings(m)) for m in (mesh, smooth))
    ctx.metric("volume_change_percent", 100.0 * (after / before - 1.0) if before else 0.0)
    ctx.metric("area_change_percent", 100.0 * (area(smooth) / area(mesh) - 1.0))
    deviation = surface_deviation(mesh, smooth, n_samples=5000)
    ctx.metric("deviation_rms_mm", deviation.rms)
    ctx.metric("deviation_max_mm", deviation.maximum)
    return {"mesh": smooth}


STAGE = Stage(
    name="smooth",
    scope="shape",
    version=1,
    config=Config,
    run=run,
    inputs=(Port("mesh", "trimesh"),),
    outputs=(Port("mesh", "trimesh"),),
    methods="Noise was reduced by {n_iterations} iterations of Taubin smoothing.",
    cites=("taubin1995",),
)

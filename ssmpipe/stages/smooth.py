"""Remove noise without shrinking the surface."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from ssmpipe.contract import Context, Port, Stage, StageConfig
from ssmpipe.core.mesh.distance import surface_deviation
from ssmpipe.core.mesh.operators import area, volume
from ssmpipe.core.mesh.topology import boundary_half_edges
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.cleaning import close_openings
from ssmpipe.core.repair.fairing import fair
from ssmpipe.core.repair.pymeshlab_filter import pymeshlab_filter
from ssmpipe.core.repair.smoothing import taubin


class Config(StageConfig):
    """Options of smooth."""

    method: Annotated[
        Literal["taubin", "bilaplacian", "curvature-flow", "pymeshlab"],
        Field(
            description="Taubin steps; one implicit step of the bilaplacian (keeps the volume best) or of mean curvature flow (shrinks), "
            "both with `cutoff_edges`; or the Taubin steps of PyMeshLab."
        ),
    ] = "taubin"
    boundary: Annotated[
        Literal["curve", "fixed"],
        Field(description="The rim is smoothed as a curve by Taubin steps, or stays where it is."),
    ] = "curve"
    cutoff_edges: Annotated[
        float, Field(gt=0, description="Length of a wave that an implicit step halves, in mean edge lengths [-].")
    ] = 8.0
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
        if self.method == "pymeshlab" and self.boundary == "fixed":
            raise ValueError("boundary: fixed is not available with method: pymeshlab; use taubin")
        return self


def run(mesh: TriMesh, *, cfg: Config, ctx: Context) -> dict[str, Any]:
    """Smooth one shape; see :func:`ssmpipe.core.repair.smoothing.taubin`."""
    smooth = _smoothed(mesh, cfg)
    before, after = (volume(close_openings(m)) for m in (mesh, smooth))
    ctx.metric("volume_change_percent", 100.0 * (after / before - 1.0) if before else 0.0)
    ctx.metric("area_change_percent", 100.0 * (area(smooth) / area(mesh) - 1.0))
    deviation = surface_deviation(mesh, smooth, n_samples=5000)
    ctx.metric("deviation_rms_mm", deviation.rms)
    ctx.metric("deviation_max_mm", deviation.maximum)
    rim = np.unique(boundary_half_edges(mesh.faces))
    if len(rim):
        moved = np.linalg.norm(smooth.vertices[rim] - mesh.vertices[rim], axis=1)
        ctx.metric("rim_moved_rms_mm", float(np.sqrt(np.mean(moved**2))))
    return {"mesh": smooth}


def _smoothed(mesh: TriMesh, cfg: Config) -> TriMesh:
    if cfg.method == "pymeshlab":
        return pymeshlab_filter(
            mesh,
            "apply_coord_taubin_smoothing",
            lambda_=cfg.lam,
            mu=cfg.mu,
            stepsmoothnum=cfg.n_iterations,
            selected=False,
        )
    fixed = cfg.boundary == "fixed"
    if cfg.method == "taubin":
        return taubin(mesh, n_iterations=cfg.n_iterations, lam=cfg.lam, mu=cfg.mu, fix_boundary=fixed)
    rim = None if fixed else taubin(mesh, n_iterations=cfg.n_iterations, lam=cfg.lam, mu=cfg.mu).vertices
    order: Literal["flow", "bilaplacian"] = "flow" if cfg.method == "curvature-flow" else "bilaplacian"
    return fair(mesh, order=order, cutoff=cfg.cutoff_edges, rim=rim)


STAGE = Stage(
    name="smooth",
    scope="shape",
    version=2,
    config=Config,
    run=run,
    inputs=(Port("mesh", "trimesh"),),
    outputs=(Port("mesh", "trimesh"),),
    methods="Noise was reduced by smoothing ({method}, {n_iterations} iterations where it iterates).",
    cites=("taubin1995",),
)

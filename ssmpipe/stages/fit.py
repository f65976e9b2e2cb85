"""Fit a B-spline surface to the sampled grid and measure its distance to the mesh."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from ssmpipe.contract import Context, Port, Stage, StageConfig
from ssmpipe.core.arrays import Floats
from ssmpipe.core.mesh.distance import point_to_mesh
from ssmpipe.core.mesh.grid import grid_faces
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.spline.fit import fit_surface, surface_grid
from ssmpipe.core.spline.poles import surface_topology
from ssmpipe.stages._fit_outline import OUTLINE


class Config(StageConfig):
    """Options of ``fit``."""

    degree: Annotated[int, Field(ge=1, le=5, description="Degree of the spline in both directions.")] = 2
    n_control: Annotated[
        tuple[int, int], Field(description="Control points per direction; 60 x 60 keeps bones within 0.1 mm.")
    ] = (60, 60)
    fairness: Annotated[
        float, Field(ge=0, description="Weight of the squared second derivative [-]; 0 is a plain least-squares fit.")
    ] = 0.0
    seam: Annotated[
        Literal["smooth", "kept"],
        Field(
            description="Where the surface closes. smooth: periodic knots, no edge along the seam, one tangent plane at a pole; "
            "kept: through the samples of the seam, with an edge there."
        ),
    ] = "smooth"
    max_rms: Annotated[
        float,
        Field(
            gt=0, description="Warn when the RMS distance between mesh and spline exceeds this share of the size [-]."
        ),
    ] = 0.005

    @model_validator(mode="after")
    def _enough(self) -> Config:
        if min(self.n_control) <= self.degree:
            raise ValueError(f"n_control must be at least degree + 1 = {self.degree + 1} per direction")
        return self


def run(*, samples: Floats, mesh: TriMesh, cfg: Config, ctx: Context) -> dict[str, Any]:
    """Fit, and report RMS and maximum distance both ways."""
    surface = fit_surface(
        samples,
        degree=(cfg.degree, cfg.degree),
        n_control=cfg.n_control,
        fairness=cfg.fairness,
        smooth=cfg.seam == "smooth",
    )
    ctx.metric("topology", surface_topology(surface))
    n_u, n_v = 4 * cfg.n_control[0] + 1, 4 * cfg.n_control[1] + 1
    dense = TriMesh(surface_grid(surface, n_u, n_v).reshape(-1, 3), grid_faces(n_u, n_v))
    to_spline = point_to_mesh(mesh.vertices, dense)[0]
    to_mesh = point_to_mesh(dense.vertices, mesh)[0]
    for name, distance in (("mesh_to_spline", to_spline), ("spline_to_mesh", to_mesh)):
        ctx.metric(f"{name}_rms_mm", float(np.sqrt((distance**2).mean())))
        ctx.metric(f"{name}_max_mm", float(distance.max()))
    size = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    rms = max(ctx.metrics["mesh_to_spline_rms_mm"], ctx.metrics["spline_to_mesh_rms_mm"])
    if rms > cfg.max_rms * size:
        ctx.warn(
            f"the spline is {rms:.3g} RMS away from the mesh ({100 * rms / size:.2f} % of its size); "
            "raise fit.n_control and sample.grid, or look at the parameterization"
        )
    return {"surface": surface}


STAGE = Stage(
    name="fit",
    scope="shape",
    version=3,
    config=Config,
    run=run,
    inputs=(Port("samples", "samples"), Port("mesh", "trimesh")),
    outputs=(Port("surface", "surface"),),
    methods="A B-spline surface of degree {degree} with {n_control} control points was fitted to each grid by "
    "end-interpolating least squares.",
    cites=("piegl1997",),
    variants=(OUTLINE,),
)

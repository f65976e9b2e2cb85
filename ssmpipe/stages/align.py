"""Move every shape rigidly onto one reference shape."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from ssmpipe.contract import Context, Landmarks, NamesShape, Port, Stage, StageConfig
from ssmpipe.core.align.icp import align, fits_better_mirrored
from ssmpipe.core.align.medoid import medoid
from ssmpipe.core.align.rigid import move, rotation_angle
from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import ConfigError
from ssmpipe.core.mesh.distance import surface_deviation
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.stages._align_outline import OUTLINE


class Config(StageConfig):
    """Options of align."""

    reference: Annotated[
        str,
        NamesShape(("medoid",)),
        Field(
            description="Shape to align to: `medoid` (the most central one), a shape id, or a mesh file in the aligned frame."
        ),
    ] = "medoid"
    start_margin: Annotated[
        float,
        Field(
            ge=0,
            lt=1,
            description="Another start must beat the shape's own pose by this share of the distance to replace it [-].",
        ),
    ] = 0.1
    n_points: Annotated[int, Field(ge=200, description="Points per surface that are matched [count].")] = 5000
    check_mirror: Annotated[
        bool, Field(description="Warn when the mirror image fits clearly better (a wrong side label).")
    ] = True


def prepare(inputs: dict[str, dict[str, Any]], *, cfg: Config, ctx: Context) -> dict[str, Any]:
    """Choose the reference among the shapes of the cohort."""
    meshes = {shape_id: slots["mesh"] for shape_id, slots in sorted(inputs.items())}
    if cfg.reference != "medoid" and cfg.reference not in meshes:
        some = ", ".join(list(meshes)[:5]) + (", ..." if len(meshes) > 5 else "")
        raise ConfigError(
            f"align.reference: there is no shape '{cfg.reference}'; the cohort has {some}",
            "use one of these ids, medoid, or a file",
        )
    chosen = medoid(meshes) if cfg.reference == "medoid" else cfg.reference
    ctx.metric("reference", chosen)
    return {"reference": meshes[chosen]}


def run(
    mesh: TriMesh,
    transform: Floats,
    reference: TriMesh,
    landmarks: Landmarks | None = None,
    *,
    cfg: Config,
    ctx: Context,
) -> dict[str, Any]:
    """Align one shape; see :func:`ssmpipe.core.align.icp.align`."""
    marks = landmarks if landmarks is not None else Landmarks()
    result = align(mesh, reference, margin=cfg.start_margin, n_points=cfg.n_points)
    aligned = move(mesh, result.matrix)
    ctx.metric("rms_mm", surface_deviation(aligned, reference, n_samples=5000).rms)
    ctx.metric("cost_mm", result.cost)
    ctx.metric("turned_deg", rotation_angle(result.matrix))
    ctx.metric("start", result.start)
    ctx.metric("n_iterations", result.n_iterations)
    if not result.converged:
        ctx.warn(
            f"alignment stopped after {result.n_iterations} iterations before it settled; check the overlay in the report"
        )
    if result.start != "identity":
        ctx.warn(
            f"the pose given by orient was replaced (start {result.start}: distance {result.cost:.3g} instead of "
            f"{result.identity_cost:.3g}, turned {rotation_angle(result.matrix):.0f} degrees); check the frame of this shape"
        )
    if cfg.check_mirror:
        better, mirrored = fits_better_mirrored(mesh, reference, result)
        ctx.metric("mirrored_cost_mm", mirrored)
        if better:
            ctx.warn(
                f"the shape fits better mirrored (distance {mirrored:.3g} instead of {result.cost:.3g}): wrong side label? "
                "look at the side column of the cohort table"
            )
    return {"mesh": aligned, "landmarks": marks.transformed(result.matrix), "transform": result.matrix @ transform}


STAGE = Stage(
    name="align",
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
    methods="Shapes were aligned rigidly to one reference ({reference}) by symmetric point-to-plane ICP from principal axes starts.",
    cites=("besl1992", "chen1992", "osada2002"),
    prepare=prepare,
    prepared=(Port("reference", "trimesh"),),
    variants=(OUTLINE,),
)

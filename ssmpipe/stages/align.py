"""Move every shape rigidly onto one reference shape."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from ssmpipe.contract import Context, Landmarks, NamesShape, Port, Stage
from ssmpipe.core.align.groupwise import align_group, union
from ssmpipe.core.align.icp import Ball, IcpResult, Region, align, align_mirrored, fits_better_mirrored
from ssmpipe.core.align.medoid import medoid
from ssmpipe.core.align.rigid import move, reflection, rotation_angle
from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import ConfigError, LandmarkError
from ssmpipe.core.mesh.distance import surface_deviation
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.decimation import decimate
from ssmpipe.stages._align_outline import OUTLINE
from ssmpipe.stages._chirality import OTHER_SIDE, ChiralityConfig, warn_of_both_images

GROUP_FACES = 60_000
"""Faces of the reference that `group` makes: the shapes are decimated to their shares of it [count]."""
# of the reference's size and radius; bones and organs of one kind stay below 1.6 and 0.13
_STRANGE_SCALE, _STRANGE_SHARE = 2.5, 0.2
_TURNED_DEG = 20.0
"""Shapes of one cohort in one anatomical frame are turned by less."""


class Config(ChiralityConfig):
    """Options of align."""

    reference: Annotated[
        str,
        NamesShape(("medoid", "group")),
        Field(
            description="What to align to: `medoid` (the most central shape), a shape id, a mesh file in the aligned frame, or `group`: "
            "all shapes at once, each first moved onto the union of the others, so that none of them is preferred."
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
    check_frame: Annotated[
        bool,
        Field(
            description="Warn when a shape had to be turned far out of the pose that orient gave it; principal axes and boxes do not "
            "tell one end from the other, so there that says nothing."
        ),
    ] = True
    region: Annotated[
        tuple[float, float] | None,
        Field(
            description="Part of the reference that counts, in fractions of its extent along `region_axis`, for shafts of different "
            "length; all of it by default [-]."
        ),
    ] = None
    region_axis: Annotated[Literal["x", "y", "z"], Field(description="Axis of the aligned frame for `region`.")] = "z"

    region_landmark: Annotated[
        str | None,
        Field(
            description="Landmark of the shape, by name or role, around which it counts, instead of `region`; all of it by default."
        ),
    ] = None
    region_radius_mm: Annotated[
        float, Field(gt=0, description="Distance from `region_landmark` up to which the shape counts [mm].")
    ] = 50.0

    @model_validator(mode="after")
    def _region_rises(self) -> Config:
        if self.region is not None and self.region_landmark is not None:
            raise ValueError("region and region_landmark exclude each other")
        if self.region is not None and not 0 <= self.region[0] < self.region[1] <= 1:
            raise ValueError("region must rise and lie between 0 and 1")
        return self


def prepare(inputs: dict[str, dict[str, Any]], *, cfg: Config, ctx: Context) -> dict[str, Any]:
    """Choose the reference among the shapes of the cohort."""
    meshes = {shape_id: slots["mesh"] for shape_id, slots in sorted(inputs.items())}
    if cfg.reference == "group":
        return {"reference": _group(meshes, ctx)}
    if cfg.reference != "medoid" and cfg.reference not in meshes:
        some = ", ".join(list(meshes)[:5]) + (", ..." if len(meshes) > 5 else "")
        raise ConfigError(
            f"align.reference: there is no shape '{cfg.reference}'; the cohort has {some}",
            "use one of these ids, medoid, group, or a file",
        )
    chosen = medoid(meshes) if cfg.reference == "medoid" else cfg.reference
    ctx.metric("reference", chosen)
    return {"reference": meshes[chosen]}


def _group(meshes: dict[str, TriMesh], ctx: Context) -> TriMesh:
    central = medoid(meshes)
    found = align_group(meshes, first=central)
    turned = found.history["turned_deg"]
    ctx.metric("reference", "group")
    ctx.metric("group_rounds", found.n_iterations)
    ctx.metric("group_turned_deg", [round(float(t), 3) for t in turned])
    if found.status != "converged":
        ctx.warn(
            f"the group still turned by {turned[-1]:.2f} degrees in round {found.n_iterations}; that is the precision of its poses"
        )
    share = max(1000, GROUP_FACES // len(meshes))
    # the central shape comes first: it gives poles and corners to the others
    order = [central, *(i for i in meshes if i != central)]
    return union({i: decimate(meshes[i], share).mesh for i in order}, found.value)


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
    region = None if cfg.region is None else Region("xyz".index(cfg.region_axis), *cfg.region)
    ball = _ball(marks, cfg)
    result = align(mesh, reference, margin=cfg.start_margin, n_points=cfg.n_points, region=region, ball=ball)
    if cfg.chirality == "best-fit":
        other = align_mirrored(mesh, reference, result, n_points=cfg.n_points, region=region, ball=ball)
        mesh, marks, transform, result = _better_image(mesh, marks, transform, reference, result, other, cfg, ctx)
    aligned = move(mesh, result.matrix)
    ctx.metric("rms_mm", surface_deviation(aligned, reference, n_samples=5000).rms)
    ctx.metric("cost_mm", result.cost)
    ctx.metric("turned_deg", rotation_angle(result.matrix))
    ctx.metric("start", result.start)
    ctx.metric("scale", result.scale)
    ctx.metric("n_iterations", result.n_iterations)
    if region is None and ball is None:
        _warn_of_strangers(reference, result, ctx)
    if not result.converged:
        ctx.warn(
            f"alignment stopped after {result.n_iterations} iterations before it settled; check "
            f"{'its page' if ctx.joins else 'the overlay in the report'}"
        )
    turned = rotation_angle(result.matrix)
    if cfg.check_frame and result.start != "identity" and cfg.chirality == "keep" and turned > _TURNED_DEG:
        ctx.warn(
            f"the pose given by orient was replaced (start {result.start}: distance {result.cost:.3g} instead of "
            f"{result.identity_cost:.3g}, turned {turned:.0f} degrees); check the frame of this shape"
        )
    if cfg.check_mirror and cfg.chirality == "keep":
        better, mirrored = fits_better_mirrored(
            mesh,
            reference,
            result,
            margin=cfg.chirality_margin,
            n_points=cfg.n_points,
            region=region,
            ball=ball,
        )
        ctx.metric("mirrored_cost_mm", mirrored)
        if better:
            advice = OTHER_SIDE if ctx.joins else "look at the side column of the cohort table"
            ctx.warn(
                f"the shape fits better mirrored (distance {mirrored:.3g} instead of {result.cost:.3g}): wrong side label? {advice}"
            )
    return {"mesh": aligned, "landmarks": marks.transformed(result.matrix), "transform": result.matrix @ transform}


def _ball(marks: Landmarks, cfg: Config) -> Ball | None:
    if cfg.region_landmark is None:
        return None
    center = marks.role(cfg.region_landmark)
    if center is None:
        names = ", ".join(f"'{name}'" for name in sorted(marks.points)[:5]) or "none"
        raise LandmarkError(
            f"there is no landmark or role '{cfg.region_landmark}' (align.region_landmark); this shape has {names}",
            "add it to the landmark file, or use align.region",
        )
    return Ball(np.asarray(center), cfg.region_radius_mm)


def _warn_of_strangers(reference: TriMesh, result: IcpResult, ctx: Context) -> None:
    """Warn of a shape that is much larger or smaller than the reference, or unlike it at equal size."""
    if not 1.0 / _STRANGE_SCALE < result.scale < _STRANGE_SCALE:
        ctx.warn(
            f"the shape is {1.0 / result.scale:.3g} times as large as the reference; check the units of its file, and that it shows the "
            "same anatomy"
        )
    share = result.cost / float(np.sqrt(reference.vertices.var(axis=0).sum()))
    if share > _STRANGE_SHARE:
        ctx.warn(
            f"the shape does not resemble the reference: at equal size their distance is {100 * share:.0f} % of its radius; check that it "
            f"shows the same anatomy{'' if ctx.joins else ', and take it out of the cohort if not'}"
        )


def _better_image(
    mesh: TriMesh,
    marks: Landmarks,
    transform: Floats,
    reference: TriMesh,
    result: IcpResult,
    other: IcpResult,
    cfg: Config,
    ctx: Context,
) -> tuple[TriMesh, Landmarks, Floats, IcpResult]:
    """Mirror a shape when its mirror image fits better; say so, and warn when neither is clearly better."""
    mirrored = other.cost < result.cost
    best, worst = sorted((result.cost, other.cost))
    # a thousandth of the size is less than the spacing of the points can tell
    fine = 1e-3 * float(np.linalg.norm(np.ptp(reference.vertices, axis=0)))
    ctx.metric("mirrored", mirrored)
    ctx.metric("other_image_cost_mm", worst)
    if best > (1.0 - cfg.chirality_margin) * worst or worst < fine:
        advice = "check the overlay, or give a column 'side' and set orient.mirror"
        warn_of_both_images(best, worst, mirrored, advice, ctx)
    if not mirrored:
        return mesh, marks, transform, result
    flip = reflection(0)
    proper = replace(other, matrix=other.matrix @ flip)
    return move(mesh, flip), marks.transformed(flip), flip @ transform, proper


STAGE = Stage(
    name="align",
    scope="shape",
    version=5,
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

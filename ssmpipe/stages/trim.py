"""Cut the surface with a plane and keep the part below it, or cut both ends of a tube."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from ssmpipe.contract import Context, Landmarks, Port, Stage, StageConfig
from ssmpipe.core.align.proximal_femur import analyze_proximal_femur
from ssmpipe.core.arrays import Floats
from ssmpipe.core.mesh.operators import area
from ssmpipe.core.mesh.topology import boundary_loops, loop_length
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.repair.extension import trim_or_extend
from ssmpipe.core.repair.trimming import height_by_width
from ssmpipe.stages._candidates import propose
from ssmpipe.stages._trim_tube import ROLES, trim_both_ends

Vector = tuple[float, float, float]


class Config(StageConfig):
    """Options of trim: a plane, or a distance, or a landmark, or a fraction of the width, in this order of precedence."""

    fraction: Annotated[
        float,
        Field(
            gt=0,
            description="Height of the cut above the lowest point, in widths of what lies below the cut along `across` [-].",
        ),
    ] = 1.1
    distance_mm: Annotated[
        float | None, Field(gt=0, description="Height of the cut above the lowest point, instead of `fraction` [mm].")
    ] = None
    offset_mm: Annotated[
        float, Field(description="Shift of the cut along `up` from the landmark with role trim [mm].")
    ] = 0.0
    up: Annotated[Vector, Field(description="Direction towards what is cut away, in the current frame [-].")] = (
        0.0,
        0.0,
        1.0,
    )
    across: Annotated[
        Vector, Field(description="Direction in which the width is measured, in the current frame [-].")
    ] = (1.0, 0.0, 0.0)
    plane_point: Annotated[
        Vector | None, Field(description="A point of the cutting plane, in the current frame [mm].")
    ] = None
    axis_fraction: Annotated[
        float | None,
        Field(
            gt=0, lt=1, description="Height of the cut in extents of the shape along `up`, instead of `fraction` [-]."
        ),
    ] = None
    find: Annotated[
        Literal["width", "trochanter"],
        Field(
            description="What geometry looks for when no landmark has the role trim: a height in widths (`fraction`), or the lesser "
            "trochanter of a femur, from which `offset_mm` counts as from a landmark."
        ),
    ] = "width"
    offset_shafts: Annotated[
        float,
        Field(
            description="Further shift along `up` from landmark or trochanter, in diameters of the shaft of a femur [-]."
        ),
    ] = 0.0
    snap: Annotated[
        float,
        Field(
            ge=0,
            lt=0.5,
            description="Vertices nearer to the plane than this share of the mean edge are moved onto it [-].",
        ),
    ] = 0.1

    ends: Annotated[
        Literal[1, 2], Field(description="Ends that are cut: 1, or 2 for a tube across its centre line [count].")
    ] = 1
    ends_at: Annotated[
        Literal["rims", "fractions", "landmarks", "sinuses"],
        Field(
            description="Where a tube is cut: just inside each ragged rim; at `end_fractions` of its centre line; through "
            "the landmarks with roles opening_1 and opening_2 (which otherwise only tell the rims apart); or below the sinuses of an "
            "aortic root that geometry finds, and through the landmark with role trim or `tube_mm` farther up (at the rims, with a "
            "warning, where there are no sinuses)."
        ),
    ] = "rims"
    end_margin_mm: Annotated[
        float, Field(gt=0, description="Distance of a tube's cuts from the innermost point of the ragged rims [mm].")
    ] = 0.5
    end_fractions: Annotated[
        tuple[float, float],
        Field(description="Where a tube is cut, in lengths of its centre line from the first rim [-]."),
    ] = (0.05, 0.95)
    below_sinuses: Annotated[
        float,
        Field(
            ge=0,
            description="With ends_at: sinuses, distance of the lower cut below the lower end of the sinuses' three lobes, in their "
            "heights; 0.35 is about the annulus [-].",
        ),
    ] = 0.35
    tube_mm: Annotated[
        float | None,
        Field(
            gt=0,
            description="With ends_at: sinuses and without a landmark of role trim, distance of the upper cut from the lower one along "
            "the centre line; without both the upper end is cut just inside its rim [mm].",
        ),
    ] = None
    extend_mm: Annotated[
        float,
        Field(
            ge=0,
            description="A scan that ends before the cut by no more than this is continued by the curvature of its rim [mm].",
        ),
    ] = 0.0

    @model_validator(mode="after")
    def _consistent(self) -> Config:
        if self.distance_mm is not None and self.plane_point is not None:
            raise ValueError("give distance_mm or plane_point, not both")
        if self.axis_fraction is not None and (self.distance_mm is not None or self.plane_point is not None):
            raise ValueError("give axis_fraction, distance_mm or plane_point, not two of them")
        if not any(self.up) or not any(self.across):
            raise ValueError("up and across must not be zero vectors")
        if not 0 <= self.end_fractions[0] < self.end_fractions[1] <= 1:
            raise ValueError("end_fractions must rise and lie between 0 and 1")
        if self.tube_mm is not None and self.ends_at != "sinuses":
            raise ValueError("tube_mm counts from the sinuses; set ends_at: sinuses")
        return self


def run(
    mesh: TriMesh, landmarks: Landmarks | None = None, transform: Floats | None = None, *, cfg: Config, ctx: Context
) -> dict[str, Any]:
    """Trim one shape; see :func:`ssmpipe.core.repair.trimming.trim`."""
    from_scan = transform if transform is not None else np.eye(4)
    if cfg.ends == 2:
        trimmed = trim_both_ends(
            mesh,
            landmarks if landmarks is not None else Landmarks(),
            from_scan,
            ctx,
            at=cfg.ends_at,
            margin=cfg.end_margin_mm,
            fractions=cfg.end_fractions,
            below_sinuses=cfg.below_sinuses,
            tube_mm=cfg.tube_mm,
            extend_mm=cfg.extend_mm,
            snap=cfg.snap,
        )
        return {"mesh": trimmed}
    up, across = (np.array(v) / np.linalg.norm(v) for v in (cfg.up, cfg.across))
    lowest = float((mesh.vertices @ up).min())
    mark = landmarks.role("trim") if landmarks is not None else None
    if cfg.plane_point is not None:
        height, source = float(np.array(cfg.plane_point) @ up), "plane"
    elif cfg.distance_mm is not None:
        height, source = lowest + cfg.distance_mm, "distance"
    elif mark is not None:
        height, source = float(mark @ up) + cfg.offset_mm, "landmark"
        if cfg.offset_shafts:
            height += cfg.offset_shafts * analyze_proximal_femur(mesh).diameter
    elif cfg.axis_fraction is not None:
        height, source = lowest + cfg.axis_fraction * float(np.ptp(mesh.vertices @ up)), "axis"
    elif cfg.find == "trochanter":
        found = analyze_proximal_femur(mesh)
        height, source = float(found.trochanter @ up) + cfg.offset_mm + cfg.offset_shafts * found.diameter, "trochanter"
        ctx.metric("shaft_diameter_mm", found.diameter)
        ctx.metric("trochanter_bulge_mm", found.bulge)
        propose({"lesser_trochanter": found.trochanter}, from_scan, ctx)
    else:
        height, width = height_by_width(mesh.vertices, up, across, cfg.fraction)
        source = "width"
        ctx.metric("width_mm", width)
    trimmed, added = trim_or_extend(mesh, height * up, up, snap=cfg.snap, extend_mm=cfg.extend_mm)
    if added > 0:
        ctx.metric("added_mm", added)
        ctx.warn(
            f"the scan ended {added:.1f} mm before the cut and was continued by the curvature of its rim; what lies there was not "
            "measured"
        )
    ctx.metric("cut_by", source)
    ctx.metric("height_mm", height - lowest)
    ctx.metric("n_vertices", trimmed.n_vertices)
    ctx.metric("n_faces", trimmed.n_faces)
    ctx.metric("area_mm2", area(trimmed))
    ctx.metric("rim_mm", loop_length(trimmed, boundary_loops(trimmed.faces)[0]))
    return {"mesh": trimmed}


def methods(options: Mapping[str, Any]) -> str:
    """Return the sentence for the methods paragraph: what the cut was made by, in the order of precedence.

    Examples
    --------
    >>> methods({"fraction": 1.1})
    'Surfaces were cut by a plane across the axis, 1.1 widths above the lowest point, or at the landmark with role trim where it was given.'
    """
    cfg = Config.model_validate(options, strict=False)
    extended = f" Scans that end earlier were continued by up to {cfg.extend_mm:g} mm." if cfg.extend_mm else ""
    if cfg.ends == 2:
        upper = (
            "just inside the other rim" if cfg.tube_mm is None else f"{cfg.tube_mm:g} mm farther along the centre line"
        )
        where = {
            "rims": f"{cfg.end_margin_mm:g} mm inside their rims",
            "fractions": f"at {cfg.end_fractions[0]:g} and {cfg.end_fractions[1]:g} of their centre line",
            "landmarks": "through the landmarks of their openings",
            "sinuses": f"{cfg.below_sinuses:g} heights of the sinuses below these, which geometry found, and {upper}, or at the landmark "
            "with role trim where it was given",
        }[cfg.ends_at]
        return f"Tubes were cut across at both ends, {where}.{extended}"
    shift = " and ".join(
        [f"{cfg.offset_mm:g} mm"] * bool(cfg.offset_mm)
        + [f"{cfg.offset_shafts:g} shaft diameters"] * bool(cfg.offset_shafts)
    )
    from_there = f", shifted by {shift}" if shift else ""
    if cfg.plane_point is not None:
        where = "through a given point"
    elif cfg.distance_mm is not None:
        where = f"{cfg.distance_mm:g} mm above the lowest point"
    else:
        where = f"{cfg.fraction:g} widths above the lowest point"
        if cfg.axis_fraction is not None:
            where = f"at {cfg.axis_fraction:g} of their extent"
        elif cfg.find == "trochanter":
            where = f"at the lesser trochanter, which geometry found{from_there}"
        where += f", or at the landmark with role trim{from_there} where it was given"
    return f"Surfaces were cut by a plane across the axis, {where}.{extended}"


STAGE = Stage(
    name="trim",
    scope="shape",
    version=6,  # continued ends do not depend on rounding: marches inward follow normals that are continuous
    config=Config,
    run=run,
    inputs=(
        Port("mesh", "trimesh"),
        Port("landmarks", "landmarks", optional=True),
        Port("transform", "transform", optional=True),
    ),
    outputs=(Port("mesh", "trimesh"),),
    methods=methods,
    roles=("trim", *ROLES),
)

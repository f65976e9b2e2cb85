"""Mirror one side to the other and bring the shape into a canonical frame."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from ssmpipe.contract import Context, Landmarks, Port, ShapeInfo, Stage, StageConfig
from ssmpipe.core.align.box import box_frame
from ssmpipe.core.align.features import femur_candidates, valley_candidates
from ssmpipe.core.align.frames import femur_distal_frame, landmark_frame, place_axes, principal_frame
from ssmpipe.core.align.proximal_femur import ProximalFemur, analyze_proximal_femur, femur_proximal_frame
from ssmpipe.core.align.rigid import move, reflection
from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import GeometryError, LandmarkError
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.stages._candidates import propose

_FRAMES = {"principal": principal_frame, "box": box_frame}
ROLES = ("lateral", "medial", "proximal")


class Config(StageConfig):
    """Options of orient."""

    mirror: Annotated[
        Literal["left", "right", "none"],
        Field(description="Side that is mirrored to the other, by the side column of the cohort table."),
    ] = "left"
    frame: Annotated[
        Literal["femur-distal", "femur-proximal", "principal", "box", "none"],
        Field(
            description="Canonical frame: x lateral, y anterior, z up the shaft of a right femur (from geometry, or from "
            "landmarks with the roles lateral, medial, proximal); of its upper end (z up the shaft below the lesser trochanter, x away "
            "from the head; whole bones and upper halves); principal axes; the sides of the smallest box; or the scanner's."
        ),
    ] = "femur-distal"
    candidates: Annotated[
        Literal["auto", "none", "femur", "valleys"],
        Field(
            description="Landmarks that geometry proposes, for the report only, in scan coordinates: fovea and lesser trochanter of a "
            "femur, or the three sharpest valleys; auto: those of a femur with frame: femur-proximal. No stage uses them."
        ),
    ] = "auto"


def run(
    mesh: TriMesh, transform: Floats, info: ShapeInfo, landmarks: Landmarks | None = None, *, cfg: Config, ctx: Context
) -> dict[str, Any]:
    """Orient one shape; see :mod:`ssmpipe.core.align.frames`."""
    marks = landmarks if landmarks is not None else Landmarks()
    mirrored = cfg.mirror != "none" and info.side == ("L" if cfg.mirror == "left" else "R")
    if cfg.mirror != "none" and info.side not in ("L", "R"):
        advice = "add a column 'side' (L or R) to the cohort table (or say --side), or set orient.mirror to none"
        if ctx.joins:
            advice = "say --side L or --side R, or give a table with the columns id and side (--cohort)"
        ctx.warn(f"the side of '{info.id}' is unknown, it is not mirrored; {advice}")
    matrix = reflection(0) if mirrored else np.eye(4)
    source, placed = "none", move(mesh, matrix)
    femur = analyze_proximal_femur(placed) if cfg.frame == "femur-proximal" else None
    _propose(placed, matrix @ transform, femur, cfg, ctx)
    if cfg.frame != "none":
        axes = _axes_from_landmarks(marks.transformed(matrix)) if cfg.frame == "femur-distal" else None
        if femur is not None:
            frame, source = femur_proximal_frame(placed, femur), "geometry"
        elif cfg.frame in _FRAMES:
            frame, source = _FRAMES[cfg.frame](placed), "geometry"
        elif axes is not None:
            frame, source = place_axes(placed, axes), "landmarks"
        else:
            frame, source = femur_distal_frame(placed), "geometry"
            ctx.metric("overhang", frame.overhang)
            if frame.overhang < 0.1:
                ctx.warn(
                    f"front and back of the condyles could not be told apart clearly; check {'its page' if ctx.joins else 'the picture'}, "
                    "or assign the roles lateral, medial and proximal to landmarks"
                )
        ctx.metric("width_mm", frame.width)
        matrix = frame.matrix @ matrix
    ctx.metric("mirrored", mirrored)
    ctx.metric("frame_from", source)
    return {"mesh": move(mesh, matrix), "landmarks": marks.transformed(matrix), "transform": matrix @ transform}


def _propose(mesh: TriMesh, transform: Floats, femur: ProximalFemur | None, cfg: Config, ctx: Context) -> None:
    wanted = cfg.candidates
    if wanted == "auto":
        wanted = "femur" if femur is not None else "none"
    if wanted == "none":
        return
    try:
        found = femur_candidates(mesh, femur) if wanted == "femur" else valley_candidates(mesh)
    except GeometryError as error:
        ctx.metric("no_landmark_candidates", error.fact)
    else:
        propose({name: candidate.point for name, candidate in found.items()}, transform, ctx)


def _axes_from_landmarks(marks: Landmarks) -> Floats | None:
    given = {role: marks.role(role) for role in ROLES}
    missing = [role for role, point in given.items() if point is None]
    if len(missing) == 3:
        return None
    lateral, medial, proximal = (given[role] for role in ROLES)
    if lateral is None or medial is None or proximal is None:
        raise LandmarkError(
            f"the frame needs all of the roles {', '.join(ROLES)}; missing: {', '.join(missing)}",
            "assign the missing ones in input.roles, or none of the three to let geometry decide",
        )
    return landmark_frame(lateral, medial, proximal)


STAGE = Stage(
    name="orient",
    scope="shape",
    version=2,
    config=Config,
    run=run,
    inputs=(
        Port("mesh", "trimesh"),
        Port("landmarks", "landmarks", optional=True),
        Port("transform", "transform"),
        Port("info", "info", columns=("side",)),
    ),
    outputs=(Port("mesh", "trimesh"), Port("landmarks", "landmarks"), Port("transform", "transform")),
    methods="Shapes were brought to one side (mirrored: {mirror}) and into a canonical frame ({frame}).",
    roles=ROLES,
)

"""Map the surface one-to-one to the unit square."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from ssmpipe.contract import Context, Landmarks, Port, Stage, StageConfig
from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import LandmarkError
from ssmpipe.core.mesh.topology import euler_characteristic
from ssmpipe.core.mesh.trimesh import TriMesh
from ssmpipe.core.parameterize.boundary import (
    aligned_axes,
    corners_by_angle,
    insert_corners,
    order_corners,
    rim_axes,
    rim_of,
    split_chords,
)
from ssmpipe.core.parameterize.distortion import folded
from ssmpipe.core.parameterize.stretch import parameterize_square

ROLES = ("corner_1", "corner_2", "corner_3", "corner_4")


class Config(StageConfig):
    """Options of parameterize."""

    corner_angles_deg: Annotated[
        tuple[float, float, float, float],
        Field(
            description="Places of the four corners around the rim's centroid, from the first to the second corner axis [deg]."
        ),
    ] = (45.0, 135.0, 225.0, 315.0)
    corner_axes: Annotated[
        Literal["frame", "aligned", "rim"],
        Field(
            description="Axes in which the angles count. frame: x and y of the aligned frame; aligned: the axes of the aligned "
            "frame turned into the plane of the rim; rim: the principal axes of the rim, each shape's own."
        ),
    ] = "frame"
    weighting: Annotated[
        Literal["mean-value", "harmonic", "uniform"],
        Field(description="Weights of the first map; only harmonic may fold."),
    ] = "mean-value"
    eta: Annotated[
        float, Field(ge=0, le=1, description="Exponent of the neighbour's stretch in the relaxation [-].")
    ] = 0.5
    max_iterations: Annotated[int, Field(ge=0, description="Rounds of stretch relaxation at most [count].")] = 50


def run(mesh: TriMesh, landmarks: Landmarks | None = None, *, cfg: Config, ctx: Context) -> dict[str, Any]:
    """Parameterize one shape; see :func:`ssmpipe.core.parameterize.stretch.parameterize_square`."""
    wanted, source = _wanted_corners(mesh, landmarks, cfg, ctx)
    with_corners, corners, away = insert_corners(mesh, wanted)
    disk = split_chords(with_corners)
    result = parameterize_square(
        disk,
        order_corners(rim_of(disk), corners),
        weighting=cfg.weighting,
        eta=cfg.eta,
        max_iterations=cfg.max_iterations,
    )
    stretch = result.history["stretch"]
    ctx.metric("stretch_before", float(stretch[0]))
    ctx.metric("stretch", float(stretch[-1]))
    ctx.metric("n_iterations", result.n_iterations)
    ctx.metric("n_flips", int(folded(result.value, disk.faces).sum()))
    ctx.metric("corners_from", source)
    ctx.metric("n_vertices", disk.n_vertices)
    ctx.metric("n_faces", disk.n_faces)
    ctx.metric("euler_characteristic", euler_characteristic(disk.faces))
    if source == "landmarks":
        ctx.metric("corner_distance_max_mm", float(away.max()))
    if result.status == "out-of-iterations" and cfg.max_iterations > 0:
        ctx.warn(f"stretch still fell after {result.n_iterations} iterations; raise parameterize.max_iterations")
    return {"mesh": disk, "uv": result.value}


def _wanted_corners(mesh: TriMesh, landmarks: Landmarks | None, cfg: Config, ctx: Context) -> tuple[Floats, str]:
    given = [landmarks.role(role) if landmarks is not None else None for role in ROLES]
    missing = [role for role, point in zip(ROLES, given, strict=True) if point is None]
    if not missing:
        return np.array(given), "landmarks"
    if len(missing) < 4:
        raise LandmarkError(
            f"the square needs all four corners; missing: {', '.join(missing)}",
            "assign the missing ones in input.roles, or none of the four to let geometry decide",
        )
    rim = rim_of(mesh)
    axes, ratio = rim_axes(mesh, rim) if cfg.corner_axes == "rim" else (np.eye(3)[:2], np.inf)
    if cfg.corner_axes == "aligned":
        axes, margin = aligned_axes(mesh, rim)
        if margin < 0.1:
            ctx.warn(
                "the rim lies askew to the aligned frame, so the choice of its axes is nearly arbitrary; assign landmarks to "
                "corner_1 to corner_4"
            )
    if ratio < 1.1:
        ctx.warn(
            f"the rim is nearly round (its axes differ by {100 * (ratio - 1):.0f} %), so its principal axes are arbitrary; "
            "assign landmarks to corner_1 to corner_4, or use corner_axes: aligned"
        )
    return corners_by_angle(mesh, rim, cfg.corner_angles_deg, axes), cfg.corner_axes


STAGE = Stage(
    name="parameterize",
    scope="shape",
    version=2,
    config=Config,
    run=run,
    inputs=(Port("mesh", "trimesh"), Port("landmarks", "landmarks", optional=True)),
    outputs=(Port("mesh", "trimesh"), Port("uv", "uv")),
    methods="Surfaces were mapped to the unit square ({weighting} weights, boundary by arc length between four corners) and their "
    "stretch was minimized.",
    cites=("floater2003", "yoshizawa2004", "li2015"),
    roles=ROLES,
)

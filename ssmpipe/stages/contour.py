"""Prepare a planar outline, from points, a mask or a photograph: closed or open, direction, starting point."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from ssmpipe.contract import Context, Landmarks, Port, Stage, StageConfig
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.outline.outline import Outline, crossings, without_repeats
from ssmpipe.stages._contour_ends import Ends, begun, directed, with_ends
from ssmpipe.stages._contour_image import IMAGE


class Config(StageConfig):
    """Options of ``contour``."""

    closed: Annotated[
        Literal["auto"] | bool,
        Field(
            description="Whether the last point joins the first; auto: it repeats it, or lies within 2 median steps of it. An outline "
            "with landmarks of the roles `start` and `end` is opened between them unless this is true."
        ),
    ] = "auto"
    orient: Annotated[
        bool,
        Field(description="Run closed outlines counter-clockwise (with x right and y up), whatever the file does."),
    ] = True
    start: Annotated[
        Literal["farthest", "first"],
        Field(
            description="First point of a closed outline without a landmark of role `start`: farthest from the centroid, or as in "
            "the file; align may move it."
        ),
    ] = "farthest"
    ends: Ends = "given"
    stem_radii: Annotated[
        float,
        Field(
            gt=1,
            description="Where the stem is cut, from the centre of the largest inscribed circle [radii of it]; with ends: stem.",
        ),
    ] = 1.5


def run(contour: Outline, landmarks: Landmarks | None = None, *, cfg: Config, ctx: Context) -> dict[str, Any]:
    """Clean one outline; its polyline stays the same, or loses its ends."""
    marks = landmarks if landmarks is not None else Landmarks()
    outline = _joined(without_repeats(contour), cfg.closed)
    if cfg.orient and outline.closed and outline.signed_area < 0:
        outline = Outline(outline.points[::-1], True)
    outline = with_ends(outline, marks, closed=cfg.closed, ends=cfg.ends, stem_radii=cfg.stem_radii, ctx=ctx)
    if not outline.closed:
        outline = directed(outline, marks)
    else:
        if abs(outline.signed_area) < 1e-9 * outline.length**2:
            raise GeometryError("the closed outline encloses no area", "check the points, or set contour.closed: false")
        outline = begun(outline, marks, cfg.start)
        ctx.metric("area_mm2", outline.signed_area)
    n_crossings = len(crossings(outline))
    if n_crossings:
        ctx.warn(f"the outline crosses itself {n_crossings} times; check the order of its points")
    ctx.metric("n_points", len(outline.points))
    ctx.metric("length_mm", outline.length)
    ctx.metric("closed", outline.closed)
    return {"contour": outline}


def _joined(outline: Outline, closed: bool | Literal["auto"]) -> Outline:
    """Apply the option ``closed``; a point that only closes the outline is not kept."""
    if closed is False:
        return Outline(outline.ring, False)
    if outline.closed:
        return outline
    gap = float(np.linalg.norm(outline.points[0] - outline.points[-1]))
    if closed is True or gap <= 2.0 * float(np.median(outline.steps)):
        return without_repeats(Outline(outline.points, True))
    return outline


STAGE = Stage(
    name="contour",
    scope="shape",
    version=2,
    config=Config,
    run=run,
    inputs=(Port("contour", "outline"), Port("landmarks", "landmarks", optional=True)),
    outputs=(Port("contour", "outline"),),
    methods="Closed outlines were run counter-clockwise.",
    roles=("start", "end"),
    variants=(IMAGE,),
)

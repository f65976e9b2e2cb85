"""Prepare a planar outline: closed or open, direction, starting point."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from ssmpipe.contract import Context, Landmarks, Port, Stage, StageConfig
from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.outline.distance import point_to_segments
from ssmpipe.core.outline.outline import Outline, crossings, start_at, without_repeats


class Config(StageConfig):
    """Options of ``contour``."""

    closed: Annotated[
        Literal["auto"] | bool,
        Field(
            description="Whether the last point joins the first; auto: it repeats it, or lies within 2 median steps of it."
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


def run(contour: Outline, landmarks: Landmarks | None = None, *, cfg: Config, ctx: Context) -> dict[str, Any]:
    """Clean one outline; its polyline stays the same."""
    marks = landmarks if landmarks is not None else Landmarks()
    outline = _with_ends(without_repeats(contour), cfg.closed)
    if not outline.closed:
        outline = _directed(outline, marks)
    else:
        if abs(outline.signed_area) < 1e-9 * outline.length**2:
            raise GeometryError("the closed outline encloses no area", "check the points, or set contour.closed: false")
        if cfg.orient and outline.signed_area < 0:
            outline = Outline(outline.points[::-1], True)
        outline = _begun(outline, marks, cfg.start)
        ctx.metric("area_mm2", outline.signed_area)
    n_crossings = len(crossings(outline))
    if n_crossings:
        ctx.warn(f"the outline crosses itself {n_crossings} times; check the order of its points")
    ctx.metric("n_points", len(outline.points))
    ctx.metric("length_mm", outline.length)
    ctx.metric("closed", outline.closed)
    return {"contour": outline}


def _with_ends(outline: Outline, closed: bool | Literal["auto"]) -> Outline:
    """Apply the option ``closed``; a point that only closes the outline is not kept."""
    if closed is False:
        return Outline(outline.ring, False)
    if outline.closed:
        return outline
    gap = float(np.linalg.norm(outline.points[0] - outline.points[-1]))
    if closed is True or gap <= 2.0 * float(np.median(outline.steps)):
        return without_repeats(Outline(outline.points, True))
    return outline


def _directed(outline: Outline, marks: Landmarks) -> Outline:
    """Let an open outline run from the landmark of role ``start`` to the one of role ``end``, as far as they are given."""
    start, end = marks.role("start"), marks.role("end")
    ends: Floats = outline.points[[0, -1]]
    turned = 0.0
    if start is not None:
        turned += float(np.linalg.norm(ends[0] - start) - np.linalg.norm(ends[1] - start))
    if end is not None:
        turned += float(np.linalg.norm(ends[1] - end) - np.linalg.norm(ends[0] - end))
    return Outline(outline.points[::-1], False) if turned > 0 else outline


def _begun(outline: Outline, marks: Landmarks, rule: str) -> Outline:
    """Move the first point of a closed outline."""
    start = marks.role("start")
    if start is not None:
        _, edge, weights = point_to_segments(start[None], outline.points, outline.edges)
        steps = outline.steps
        return start_at(outline, float(steps[: edge[0]].sum() + weights[0, 1] * steps[edge[0]]))
    if rule == "first":
        return outline
    middle = 0.5 * (outline.points + np.roll(outline.points, -1, axis=0))
    centroid = outline.steps @ middle / outline.length
    farthest = int(np.argmax(np.linalg.norm(outline.points - centroid, axis=1)))
    return Outline(np.roll(outline.points, -farthest, axis=0), True)


STAGE = Stage(
    name="contour",
    scope="shape",
    version=1,
    config=Config,
    run=run,
    inputs=(Port("contour", "outline"), Port("landmarks", "landmarks", optional=True)),
    outputs=(Port("contour", "outline"),),
    methods="Closed outlines were run counter-clockwise.",
    roles=("start", "end"),
)

"""What the stage ``contour`` does with ends and starting points, whatever the outline comes from."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

import numpy as np
from pydantic import Field

from ssmpipe.contract import Context, Landmarks
from ssmpipe.core.arrays import Floats
from ssmpipe.core.errors import GeometryError
from ssmpipe.core.outline.distance import point_to_segments
from ssmpipe.core.outline.ends import between, cut_stem
from ssmpipe.core.outline.outline import Outline, start_at

Ends: TypeAlias = Annotated[
    Literal["given", "stem"],
    Field(
        description="Ends of an outline without landmarks of the roles `start` and `end`. given: as they are, where the shape leaves "
        "the picture; stem: both where its stem (the wrist of a hand) is cut off, a place that depends on the shape alone."
    ),
]


def with_ends(
    outline: Outline, marks: Landmarks, *, closed: bool | Literal["auto"], ends: str, stem_radii: float, ctx: Context
) -> Outline:
    """Open or shorten an outline: between the landmarks of the roles ``start`` and ``end``, or at its stem."""
    start, end = marks.role("start"), marks.role("end")
    if closed is True:
        return outline
    if start is not None and end is not None:
        ctx.metric("ends_from", "landmarks")
        return between(outline, start, end)
    if ends == "stem":
        try:
            cut = cut_stem(outline, stem_radii)
        except GeometryError as error:
            if outline.closed:
                raise
            ctx.warn(f"{error.fact}: the outline keeps its ends as they are; {error.remedy}")
        else:
            ctx.metric("ends_from", "stem")
            return cut
    return outline


def directed(outline: Outline, marks: Landmarks) -> Outline:
    """Let an open outline run from the landmark of role ``start`` to the one of role ``end``, as far as they are given."""
    start, end = marks.role("start"), marks.role("end")
    ends: Floats = outline.points[[0, -1]]
    turned = 0.0
    if start is not None:
        turned += float(np.linalg.norm(ends[0] - start) - np.linalg.norm(ends[1] - start))
    if end is not None:
        turned += float(np.linalg.norm(ends[1] - end) - np.linalg.norm(ends[0] - end))
    return Outline(outline.points[::-1], False) if turned > 0 else outline


def begun(outline: Outline, marks: Landmarks, rule: str) -> Outline:
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
